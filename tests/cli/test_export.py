"""The export command: what it writes, what it says, and what it refuses."""

from pathlib import Path

import pytest

from telebip.cli.export import main
from telebip.errors import UserError
from telebip.rl.checkpoint import load_checkpoint


def test_it_exports_and_says_how_exactly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "policy.onnx"
    main(["--checkpoint", "telebip_flat", "--out", str(out)])
    first, second = capsys.readouterr().out.splitlines()
    assert f"wrote {out}" in first
    assert "after 320 iterations of telebip_flat" in first
    assert float(second.split("by ")[1].split()[0]) < 1e-5
    assert "10000 random observations" in second
    assert load_checkpoint(out).task == "telebip_flat"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--checkpoint", "telebip_flat", "--out", "policy.pt"], r"--out writes FILE.onnx, got 'policy.pt'"),
        (["--checkpoint", "telebip_falt"], r"'telebip_falt' does not exist; policies that come with telebip: .*telebip_flat"),
        (["--out", "policy.onnx"], r"required: --checkpoint"),
        (["--checkpoint", "telebip_efficient", "ppo.symmetry=none"], r"'ppo.symmetry=none': a network is exported as it was"),
    ],
)
def test_a_mistake_is_one_line(arguments: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        main(arguments)
