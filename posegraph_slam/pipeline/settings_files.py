"""Layers of TOML files and `--set` overrides merged into any `Settings` model, and models written back as TOML.

Every value remembers the layer that it came from, so that an error names the file, the key and what is allowed.
"""

from __future__ import annotations

import difflib
import json
import tomllib
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ValidationError
from pydantic.fields import FieldInfo

from posegraph_slam.errors import ConfigurationError, did_you_mean
from posegraph_slam.settings import Settings

Model = TypeVar("Model", bound=Settings)

UNSET = "none"
"""How a file says that an optional key has no value, which TOML has no word for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Layer:
    """Nested `values` and the file or option that they came from."""

    source: str
    values: Mapping[str, Any]


def read_layer(path: Path) -> Layer:
    """Read one TOML file; raise ConfigurationError where it is missing or is not TOML."""
    try:
        with path.open("rb") as file:
            return Layer(source=str(path), values=tomllib.load(file))
    except OSError as error:
        raise ConfigurationError(path, f"cannot be read ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise ConfigurationError(path, f"is not valid TOML: {error}") from error


def parse_override(text: str) -> Layer:
    """Turn `a.b=value` into a layer; the value is read as TOML and, failing that, taken as a string."""
    key, equals, value = text.partition("=")
    parts = [part.strip() for part in key.split(".")]
    if not equals or not all(parts):
        raise ConfigurationError(f"--set {text}", "is not of the form section.key=value")
    values: Any = _parse_value(value.strip())
    for part in reversed(parts):
        values = {part: values}
    return Layer(source="--set", values=values)


def _parse_value(text: str) -> Any:
    try:
        parsed = tomllib.loads(f"value = {text}")
    except (ValueError, RecursionError):
        return text
    return parsed["value"] if set(parsed) == {"value"} else text


def build_settings(model: type[Model], layers: Sequence[Layer], *, listing: str = "psg config show") -> Model:
    """Merge `layers`, later ones over earlier ones and all over the defaults, and validate the result.

    Raises ConfigurationError naming the layer, the dotted key, what is allowed there, and for an unknown key the
    nearest known one, or else the command `listing` that prints them all. Types are strict: a string is not taken
    for a number nor a number for true.
    """
    # all defaults are written out, since a section's own defaults may differ from those of its class
    values, sources = model().model_dump(mode="json"), dict[str, str]()
    fields, sections = {name: info for name, info, _ in walk_fields(model)}, dict(walk_sections(model))
    for layer in layers:
        for dotted, value in _flatten(model, layer.values):
            if dotted not in fields:
                raise _no_such_field(layer.source, dotted, fields, sections, listing)
            *parents, last = dotted.split(".")
            section = values
            for parent in parents:
                section = section[parent]
            section[last] = None if value == UNSET and _is_optional(fields[dotted]) else value
            sources[dotted] = layer.source
    try:
        return model.model_validate_json(json.dumps(values, default=str), strict=True)
    except ValidationError as error:
        raise _explain(model, error, sources) from error


def _flatten(model: type[Settings], values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield dotted key and value; tables are followed as deep as `model` has sections."""
    for key, value in values.items():
        section = _section(model.model_fields[key]) if key in model.model_fields else None
        if section is not None and isinstance(value, Mapping):
            yield from _flatten(section, value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _no_such_field(
    source: str, dotted: str, fields: Iterable[str], sections: Mapping[str, type[Settings]], listing: str
) -> ConfigurationError:
    """Say that `dotted` is no field, and what is near it."""
    if dotted in sections:
        known = ", ".join(f"{dotted}.{name}" for name in sections[dotted].model_fields)
        return ConfigurationError(source, f"'{dotted}' is a section, not a value", f"its keys are {known}")
    near = _nearest(dotted, [*fields, *sections])
    remedy = f"did you mean '{near}'?" if near else f"`{listing}` lists every key"
    return ConfigurationError(source, f"unknown key '{dotted}'", remedy)


def _nearest(dotted: str, known: Sequence[str]) -> str | None:
    last = dotted.rsplit(".", 1)[-1]
    near = difflib.get_close_matches(dotted, known, n=1, cutoff=0.8)
    near += [name for name in known if name.rsplit(".", 1)[-1] == last]
    near += difflib.get_close_matches(dotted, known, n=1, cutoff=0.5)
    return near[0] if near else None


def _explain(model: type[Settings], error: ValidationError, sources: Mapping[str, str]) -> ConfigurationError:
    problems = error.errors()
    first = problems[0]
    names = [str(part) for part in first["loc"] if isinstance(part, str)]
    fields = {name: info for name, info, _ in walk_fields(model)}
    dotted = next((".".join(names[:n]) for n in range(len(names), 0, -1) if ".".join(names[:n]) in fields), "")
    more = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    if not dotted:  # a rule that spans several keys
        section = ".".join(names)
        touched = sorted({source for key, source in sources.items() if key.startswith(section)})
        where = ", ".join(touched) or "configuration"
        return ConfigurationError(where, f"{section or 'configuration'}: {_sentence(first['msg'])}{more}")
    given = json.dumps(first["input"], default=str)
    guess = did_you_mean(str(first["input"]), choices(fields[dotted].annotation))
    return ConfigurationError(
        sources.get(dotted, "configuration"),
        f"'{dotted}' = {given} is not allowed",
        f"{guess}it must be {allowed(fields[dotted])}{more}",
    )


def choices(annotation: Any) -> list[str]:
    """Return the words that a field of a Literal or Enum type takes, none for other types."""
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return [str(member.value) for member in annotation]
    if typing.get_origin(annotation) is typing.Literal:
        return [str(choice) for choice in typing.get_args(annotation)]
    return [word for argument in typing.get_args(annotation) for word in choices(argument)]


def _sentence(message: str) -> str:
    return message.removeprefix("Value error, ")


def walk_fields(model: type[Settings], prefix: str = "") -> Iterator[tuple[str, FieldInfo, str]]:
    """Yield dotted name, field and section of every value of `model`, sections inside sections included."""
    for name, info in model.model_fields.items():
        section = _section(info)
        if section is None:
            yield f"{prefix}{name}", info, prefix.rstrip(".")
        else:
            yield from walk_fields(section, f"{prefix}{name}.")


def walk_sections(model: type[Settings], prefix: str = "") -> Iterator[tuple[str, type[Settings]]]:
    """Yield dotted name and model of every section of `model`, in order, outer ones first."""
    for name, info in model.model_fields.items():
        section = _section(info)
        if section is not None:
            yield f"{prefix}{name}", section
            yield from walk_sections(section, f"{prefix}{name}.")


def _section(info: FieldInfo) -> type[Settings] | None:
    annotation = info.annotation
    return annotation if isinstance(annotation, type) and issubclass(annotation, Settings) else None


def _is_optional(info: FieldInfo) -> bool:
    return type(None) in typing.get_args(info.annotation)


def allowed(info: FieldInfo) -> str:
    """Say in words which values a field takes: its type or choices, and its range."""
    bounds = []
    for attribute, sign in (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="), ("multiple_of", "a multiple of")):
        bounds += [f"{sign} {getattr(rule, attribute):g}" for rule in info.metadata if hasattr(rule, attribute)]
    words = _type_words(info.annotation) + (" " + " and ".join(bounds) if bounds else "")
    return f"{words}, or {json.dumps(UNSET)}" if _is_optional(info) else words


def _type_words(annotation: Any) -> str:
    arguments = typing.get_args(annotation)
    origin = typing.get_origin(annotation)
    if origin is typing.Annotated:
        return _type_words(arguments[0])
    if origin is typing.Literal:
        return "one of " + ", ".join(json.dumps(choice) for choice in arguments)
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_type_words(argument) for argument in arguments if argument is not type(None))
    if origin in (tuple, list):
        counted = "" if Ellipsis in arguments or origin is list else f"{len(arguments)} "
        return f"a list of {counted}values, each {_type_words(arguments[0])}"
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return "one of " + ", ".join(json.dumps(member.value) for member in annotation)
    words = {bool: "true or false", int: "an integer", float: "a number", str: "a string", Path: "a path"}
    return words.get(annotation, f"a {getattr(annotation, '__name__', annotation)}")


def to_toml(settings: Settings) -> str:
    """Write every key of `settings` as TOML, each under a comment that describes it and names its range."""
    lines: list[str] = []
    _write_section(settings, "", _title(type(settings)), lines)
    return "\n".join(lines).strip() + "\n"


def _write_section(settings: Settings, name: str, title: str, lines: list[str]) -> None:
    fields = type(settings).model_fields
    values = {key: info for key, info in fields.items() if _section(info) is None}
    if values or not fields:
        lines += ["", *_comment(title), f"[{name}]"] if name else [*_comment(title), ""]
    for key, info in values.items():
        description = (info.description or "").strip().split("\n\n")[0]
        lines += [*_comment(description, allowed(info)), f"{key} = {_toml(getattr(settings, key))}"]
    for key, info in fields.items():
        section = _section(info)
        if section is not None:
            title = info.description or _title(section)
            _write_section(getattr(settings, key), f"{name}.{key}".lstrip("."), title, lines)


def _title(model: type[Settings]) -> str:
    return (model.__doc__ or "").strip().split("\n")[0]


def _comment(text: str, bracket: str = "", width: int = 110) -> list[str]:
    """Break text into comment lines, with what is in brackets unbroken at the end."""
    lines, line = [], "#"
    for word in [*text.split(), *([f"[{bracket}]"] if bracket else [])]:
        if len(line) + 1 + len(word) > width and line != "#":
            lines.append(line)
            line = "#"
        line += f" {word}"
    return [*lines, line] if line != "#" else lines


def _toml(value: Any) -> str:
    if value is None:
        return json.dumps(UNSET)
    if isinstance(value, Enum):
        return _toml(value.value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    if isinstance(value, float):
        return repr(float(value))
    if isinstance(value, bool | int):
        return json.dumps(value)
    return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
