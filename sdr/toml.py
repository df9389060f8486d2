"""TOML files: found by built-in name or by path, overridden by ``key=value``, and validated with one sentence of refusal."""

import tomllib
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

T = TypeVar("T", bound=BaseModel)
MAX_BYTES = 1 << 20


def built_in(kind: str) -> list[str]:
    """Names of the files that come with the package; ``kind``: "scenario" or "campaign"."""
    names = (p.name for p in (files("sdr") / f"{kind}s").iterdir())
    return sorted(n.removesuffix(".toml") for n in names if n.endswith(".toml"))


def read(name_or_path: str, kind: str) -> str:
    """Text of a built-in file or of one at a path; ValueError says what there is."""
    path = Path(name_or_path)
    if path.suffix != ".toml" and name_or_path in built_in(kind):
        return (files("sdr") / f"{kind}s" / f"{name_or_path}.toml").read_text(encoding="utf-8")
    if not path.is_file():
        raise ValueError(
            f"{kind} '{name_or_path}' is neither a file nor a built-in name; built in are: {', '.join(built_in(kind))}"
        )
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{kind} '{path}' is larger than {MAX_BYTES} bytes; a {kind} is a short TOML text")
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError:
        raise ValueError(f"{kind} '{path}' is not UTF-8 text; a {kind} is a TOML file") from None


def table(text: str, origin: str, overrides: Sequence[str] = ()) -> dict[str, Any]:
    """Parsed ``text`` with overrides; ``origin`` names it in errors."""
    try:
        parsed = tomllib.loads(text)
    except tomllib.TOMLDecodeError as err:
        raise ValueError(f"{origin} is not valid TOML: {err}") from None
    override(parsed, overrides)
    return parsed


def override(table: dict[str, Any], overrides: Sequence[str]) -> None:
    """Set dotted keys of ``table``; values are TOML, and what is not is taken as a string."""
    for one in overrides:
        key, equals, value = one.partition("=")
        if not equals or not all(key.split(".")):
            raise ValueError(f"--set '{one}' is not key=value, e.g. --set receiver.tracking.l1ca.dll_bw_hz=1")
        try:
            parsed = tomllib.loads(f"v = {value}")["v"]
        except tomllib.TOMLDecodeError:
            parsed = value
        *path, last = key.split(".")
        node: Any = table
        for part in path:
            node = node.setdefault(part, {})
            if not isinstance(node, dict):
                raise ValueError(f"--set {key}: '{part}' is not a section that can be overridden by key")
        node[last] = parsed


def validate(model: type[T], table: dict[str, Any], origin: str) -> T:
    """Validate ``table`` as ``model``, with pydantic's report turned into one sentence."""
    try:
        return model.model_validate(table)
    except ValidationError as err:
        raise ValueError(f"{origin}: {_sentence(model, err)}") from None


def _sentence(model: type[BaseModel], err: ValidationError) -> str:
    first, *rest = err.errors(include_url=False)
    keys = [str(k) for k in first["loc"]]
    where = ".".join(keys) or "the file"
    message = first["msg"].removeprefix("Value error, ")
    if first["type"] == "extra_forbidden":
        allowed = _allowed_keys(model, first["loc"][:-1])
        text = f"'{where}' is not a known key" + (f"; allowed there: {', '.join(allowed)}" if allowed else "")
    elif first["type"] == "missing":
        text = f"'{where}' is missing; it has no default"
    elif first["type"].startswith("union_tag"):
        tags = first["ctx"].get("expected_tags")
        said = f" = {first['ctx']['tag']!r} is not one of {tags}" if tags else " is missing"
        text = f"'{where}.{first['ctx']['discriminator'].strip(chr(39))}'{said}"
    else:
        value = first.get("input")
        shown = f" = {value!r}" if isinstance(value, str | int | float | bool) else ""
        # pydantic's own messages begin with a capital; ours may begin with PLL.
        text = f"'{where}'{shown}: {message if message[:2].isupper() else message[0].lower() + message[1:]}"
    others = list(dict.fromkeys(".".join(map(str, e["loc"])) for e in rest))
    if not others:
        return text
    names = ", ".join(f"'{name}'" for name in others[:3])
    return text + f"; then see to {names}" + (f" and {len(others) - 3} more" if len(others) > 3 else "")


def _allowed_keys(model: type[BaseModel], loc: tuple[Any, ...]) -> list[str]:
    """Keys of the section at ``loc``, as far as the path leads through plain nested models."""
    current: Any = model
    for key in loc:
        field = getattr(current, "model_fields", {}).get(str(key))
        if field is None:
            return []
        current = field.annotation
    return sorted(f.alias or n for n, f in getattr(current, "model_fields", {}).items())
