"""HTML that is safe by construction: every text is escaped unless it is markup that was made here."""

from __future__ import annotations

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping
from importlib.resources import files

from posegraph_slam.pipeline.run_directory import plain

VOID = frozenset({"br", "hr", "img", "input", "meta", "link", "rect", "path", "line", "circle", "col"})
_PLACE = re.compile(r"\{\{(\w+)\}\}")


class Markup(str):
    """Text that is HTML already; everything else is escaped where it enters."""

    __slots__ = ()


Content = str | int | None
Attribute = str | int | float | bool | None


def element(tag: str, *content: Content, **attributes: Attribute) -> Markup:
    """Return `<tag attributes>content</tag>`, contents and values escaped unless they are `Markup`.

    `class_` becomes class, other underscores hyphens; True gives a bare attribute, False and None none.
    """
    written = "".join(_attribute(name, value) for name, value in attributes.items())
    if tag in VOID:
        return Markup(f"<{tag}{written}>" if tag not in SVG_VOID else f"<{tag}{written}/>")
    return Markup(f"<{tag}{written}>{join(*content)}</{tag}>")


SVG_VOID = frozenset({"rect", "path", "line", "circle"})


def join(*content: Content) -> Markup:
    """Put contents one after another; None is nothing."""
    return Markup("".join(escaped(each) for each in content if each is not None))


def escaped(content: str | int) -> str:
    """Escape a text for element content and quoted attributes; `Markup` stays as it is."""
    return str(content) if isinstance(content, Markup) else html.escape(str(content), quote=True)


def _attribute(name: str, value: Attribute) -> str:
    if value is None or value is False:
        return ""
    key = name.rstrip("_").replace("_", "-")
    return f" {key}" if value is True else f' {key}="{escaped(str(value))}"'


def fill(template: str, parts: Mapping[str, Markup]) -> Markup:
    """Put `parts` in the places {{name}} of a template, in one pass: what is put in is not searched again."""
    return Markup(_PLACE.sub(lambda place: parts[place[1]], template))


def json_block(identity: str, value: object) -> Markup:
    """Return a script element that holds JSON, in which no text can end the element or open a comment."""
    text = json.dumps(plain(value), separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    for character in "<>&":
        text = text.replace(character, f"\\u{ord(character):04x}")
    return Markup(f'<script type="application/json" id="{escaped(identity)}">{text}</script>')


def asset(name: str) -> str:
    """Return the text of a file in `assets/`."""
    return (files(__package__) / "assets" / name).read_text(encoding="utf-8")


def content_hash(text: str) -> str:
    """Return how a content security policy names an inline style or script."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def data_uri(content: bytes, kind: str = "image/png") -> str:
    """Return bytes as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"
