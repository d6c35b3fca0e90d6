"""Values of checkpoints, and those that ranks send each other, as JSON and tensors.

Ranks do not authenticate each other, so messages are never unpickled. Decoding creates plain values, tensors,
and dataclasses and errors of this project; it runs no code that the sender chooses.
"""

import json
from dataclasses import fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load, save
from torch import Tensor

from sgsst_core.errors import SgsstError

#: Packages whose dataclasses and errors a message may hold.
_PACKAGES = ("sgsst_core", "worker")
#: Name of the JSON among the tensors of a message.
_JSON = "json"


def encode(value: Any) -> Tensor:
    """Return a message as a tensor [n] uint8.

    Raises:
        TypeError: If the value holds an object of an unsupported type.
    """
    tensors: dict[str, Tensor] = {}
    text = json.dumps(to_json(value, tensors)).encode()
    tensors[_JSON] = torch.frombuffer(bytearray(text), dtype=torch.uint8)
    return torch.frombuffer(bytearray(save(tensors)), dtype=torch.uint8)


def decode(message: Tensor) -> Any:
    """Return the value of a message [n] uint8.

    Raises:
        ValueError: If the bytes are not a valid message.
    """
    try:
        tensors = load(message.numpy().tobytes())
        return from_json(json.loads(tensors[_JSON].numpy().tobytes()), tensors)
    except Exception as error:  # safetensors raises its own type, and a value of a wrong type can fail anywhere
        raise ValueError(f"Another rank sent something that is not a message of this program: {error}") from error


def to_json(value: Any, tensors: dict[str, Tensor]) -> Any:
    """Convert a value to JSON.

    Scalars and lists stay as they are. Any other value becomes an object whose only key is the kind of the value.
    """

    def each(values: Any) -> list[Any]:
        return [to_json(item, tensors) for item in values]

    def add(tensor: Tensor) -> str:
        name = str(len(tensors))
        tensors[name] = tensor.detach().cpu().clone(memory_format=torch.contiguous_format)  # must not share memory
        return name

    match value:
        case None | bool() | int() | float() | str():
            return value
        case list():
            return each(value)
        case tuple() if type(value) in (tuple, torch.Size):
            return {"tuple": each(value)}
        case dict():
            return {"dict": each(value.items())}
        case bytes():
            return {"bytes": value.decode("latin-1")}
        case Path():
            return {"path": str(value)}
        case Tensor():
            return {"tensor": [add(value), value.device.type]}
        case np.ndarray():
            return {"array": add(torch.from_numpy(value))}
        case SgsstError():
            return {"error": [_name_of(type(value)), each(value.args)]}
    if is_dataclass(value) and not isinstance(value, type):
        members = {field.name: to_json(getattr(value, field.name), tensors) for field in fields(value)}
        return {"object": [_name_of(type(value)), members]}
    raise TypeError(f"A message between ranks cannot hold a {type(value).__name__}")


def from_json(value: Any, tensors: dict[str, Tensor]) -> Any:
    """Convert JSON from `to_json` back to a value."""

    def each(values: Any) -> list[Any]:
        return [from_json(item, tensors) for item in values]

    if isinstance(value, list):
        return each(value)
    if not isinstance(value, dict):
        return value
    ((kind, content),) = value.items()
    match kind:
        case "tuple":
            return tuple(each(content))
        case "dict":
            return dict(each(content))
        case "bytes":
            return content.encode("latin-1")
        case "path":
            return Path(content)
        case "tensor":
            name, device = content
            return tensors[name].to(device)
        case "array":
            return tensors[content].numpy()
        case "error":
            error = _class(content[0])
            if not issubclass(error, SgsstError):
                raise ValueError(f"{content[0]} is not an error of this program")
            return error(*each(content[1]))
        case "object":
            return _object(content[0], {name: from_json(member, tensors) for name, member in content[1].items()})
    raise ValueError(f"unknown kind {kind!r}")


def _object(name: str, members: dict[str, Any]) -> Any:
    """Return an instance of a dataclass with these members, without calling its constructor."""
    kind = _class(name)
    if not is_dataclass(kind) or members.keys() != {field.name for field in fields(kind)}:
        raise ValueError(f"{name} is not a dataclass with the members {', '.join(members)}")
    instance = object.__new__(kind)
    for member, value in members.items():
        object.__setattr__(instance, member, value)  # works for frozen dataclasses, too
    return instance


def _name_of(kind: type) -> str:
    name = f"{kind.__module__}:{kind.__qualname__}"
    if _class(name) is not kind:
        raise TypeError(f"A message between ranks cannot hold a {name}")
    return name


def _class(name: str) -> type:
    """Return the class that a "module:name" refers to; it must belong to this project."""
    module, _, own = name.partition(":")
    if module.partition(".")[0] not in _PACKAGES:
        raise TypeError(f"{name} is not a class of {' or '.join(_PACKAGES)}")
    kind = getattr(import_module(module), own)
    if not isinstance(kind, type) or kind.__module__ != module:
        raise TypeError(f"{name} is not a class")
    return kind
