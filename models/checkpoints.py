"""Networks as bytes: safetensors with JSON metadata, never pickle."""

import json
from dataclasses import asdict
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from models.families import family_named
from models.network import Network
from models.policies.diffusion import DiffusionPolicy, DiffusionPolicyConfig
from models.spaces import Spaces

FORMAT = 1


class CheckpointError(ValueError):
    """Bytes that are not the checkpoint that was expected; the message says what was expected and what was found."""


def save(model: Network) -> bytes:
    """Equal weights, config and spaces give equal bytes."""
    description = {
        "format": FORMAT,
        "family": model.family,
        "kind": model.kind,
        "config": asdict(model.config),
        "spaces": model.spaces.to_json(),
    }
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    return save_tensors(tensors, {"asim": json.dumps(description, sort_keys=True)})


def load(data: bytes, expect_kind: str | None = None, expect_family: str | None = None) -> Network:
    """The network that `save` wrote, on the CPU. Raises CheckpointError."""
    description = describe(data)
    for field, expected in (("kind", expect_kind), ("family", expect_family)):
        found = description.get(field)
        if expected is not None and found != expected:
            raise CheckpointError(f"Expected a checkpoint of {field} {expected!r}, found {field} {found!r}.")
    try:
        model = _built(description)
        model.load_state_dict(load_tensors(data))
    except (SafetensorError, RuntimeError, KeyError, TypeError, ValueError) as error:
        expected = f"{description.get('family')} {description.get('kind')}"
        raise CheckpointError(f"Expected the tensors and config of a {expected}, found others: {error}") from error
    return model


def describe(data: bytes) -> dict[str, Any]:
    """Format, family, kind, config and spaces of a checkpoint, without its tensors. Raises CheckpointError."""
    length = int.from_bytes(data[:8], "little")
    if len(data) < 8 or length > len(data) - 8:
        raise CheckpointError(f"Expected a safetensors checkpoint, found {len(data)} truncated or foreign bytes.")
    try:
        description = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["asim"])
    except (ValueError, KeyError, TypeError) as error:
        raise CheckpointError("Expected a checkpoint with our metadata, found a header without it.") from error
    if not isinstance(description, dict) or description.get("format") != FORMAT:
        raise CheckpointError(f"Expected a checkpoint of format {FORMAT}, found {description!r:.80}.")
    return description


def _built(description: dict[str, Any]) -> Network:
    spaces = Spaces.from_json(description["spaces"])
    # The weights drawn here are overwritten by the checkpoint's.
    drawn = torch.Generator().manual_seed(0)
    if description["kind"] == DiffusionPolicy.kind:  # policies belong to no family of models
        return DiffusionPolicy(spaces, DiffusionPolicyConfig(**description["config"]), drawn)
    return family_named(description["family"]).build(description["kind"], spaces, description["config"], drawn)
