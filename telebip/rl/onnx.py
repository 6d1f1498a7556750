"""Policies as ONNX files, which `telebip.rl.export` writes: they carry their own description and need no torch to run."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from telebip.errors import UserError

FORMAT = "telebip-onnx-2"
INPUT, OUTPUT = "obs", "actions"


class OnnxPolicy:
    """A `telebip.control.policy.Policy` that onnxruntime evaluates on the CPU, one thread, wherever the worlds live."""

    def __init__(self, model: Path | bytes, device: str | torch.device = "cpu") -> None:
        """Load a file, or a file's bytes.

        Raises:
            UserError: the file cannot be read, telebip did not write it, or onnxruntime is not installed.
        """
        name = "<bytes>" if isinstance(model, bytes) else str(model)
        try:
            import onnxruntime
        except ImportError as error:
            raise UserError(f"'{name}' is an ONNX file; to run it: pip install 'telebip[export]'") from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1  # the network is small, and the physics wants the other processors
        try:
            content = model if isinstance(model, bytes) else model.read_bytes()
            self._session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
        except OSError as error:
            raise UserError(f"policy '{name}' cannot be read: {error.strerror or error}") from error
        except Exception as error:  # onnxruntime's exceptions have no common base
            raise UserError(f"policy '{name}' is not a valid ONNX file") from error
        self.metadata = self._metadata(name)
        self._device = torch.device(device)

    def __call__(self, obs: TensorDict) -> Tensor:
        """See `Policy`."""
        return torch.from_numpy(self.act(obs["policy"].cpu().numpy())).to(self._device)

    def reset(self, mask: Tensor, /) -> None:
        """Nothing to forget."""

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Return the actions (num_envs, num_joints) for float32 observations (num_envs, size)."""
        return self._session.run([OUTPUT], {INPUT: obs})[0]  # type: ignore[return-value]

    def _metadata(self, name: str) -> dict[str, Any]:
        """Return the description that the file carries; its keys are those of `telebip.rl.export.describe`."""
        texts = self._session.get_modelmeta().custom_metadata_map
        if texts.get("format") != json.dumps(FORMAT):
            raise UserError(f"policy '{name}' was not exported by telebip, or by a version that this one cannot read")
        return {key: json.loads(text) for key, text in texts.items()}


def set_metadata(model: Any, metadata: dict[str, Any]) -> None:
    """Replace whatever an `onnx.ModelProto` says about itself by `metadata`: one property a key, its value as JSON."""
    graph = model.graph
    parts: Sequence[Any] = (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer)
    for part in parts:  # the exporter leaves the paths and lines of its own code
        part.ClearField("metadata_props")
    model.doc_string = ""
    for key, value in {"format": FORMAT, **metadata}.items():
        model.metadata_props.add(key=key, value=json.dumps(value))
