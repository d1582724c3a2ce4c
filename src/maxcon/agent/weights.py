"""Weights as safetensors, with the configuration in the header: one file is an agent."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.numpy import save

from maxcon.agent.config import AgentConfig

if TYPE_CHECKING:
    from maxcon.agent.network import QNetwork


def save_weights(network: QNetwork, config: AgentConfig, path: Path) -> None:
    """Write the network's parameters and the configuration that made them, replacing `path` atomically."""
    tensors = {name: value.detach().numpy().copy() for name, value in network.state_dict().items()}
    part = path.with_suffix(".part")
    part.write_bytes(save(tensors, {"config": json.dumps(config.to_dict(), sort_keys=True)}))
    os.replace(part, path)


def load_weights(path: Path) -> tuple[dict[str, NDArray[np.float32]], AgentConfig]:
    """Return the parameters and the configuration of an agent file.

    Raises
    ------
    ValueError
        If the file is not an agent of this package.
    """
    try:
        with safe_open(str(path), framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except FileNotFoundError:
        raise ValueError(f"weights must name an agent file, but there is no file {str(path)!r}") from None
    except Exception as error:  # safetensors raises a class of its own for each broken header
        raise ValueError(f"weights must be a safetensors file, but {str(path)!r} is not: {error}") from None
    if "config" not in metadata and any(name.startswith("peel.") for name in tensors):
        raise ValueError(
            f"weights must be an agent file of maxcon, but {str(path)!r} holds a pair of search networks: these are "
            "for the method 'learned' and its option 'network' (--method learned --option network=FILE)"
        )
    if "config" not in metadata:
        raise ValueError(f"weights must be an agent file of maxcon, but {str(path)!r} holds no configuration")
    try:
        return tensors, AgentConfig.from_dict(json.loads(metadata["config"]))
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"weights must be an agent file of this version of maxcon, but {str(path)!r}: {error}"
        ) from None
