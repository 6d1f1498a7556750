"""Export a policy to ONNX: `python scripts/export.py --checkpoint assets/policies/telebip_flat --out policy.onnx`."""

from telebip.cli.common import run
from telebip.cli.export import main

if __name__ == "__main__":
    run(main)
