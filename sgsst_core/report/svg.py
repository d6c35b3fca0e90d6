"""Conversion of figures to inline SVG that can share a page with other figures.

Colors are CSS variables with the printed color as fallback (`var(--c-222222, #222222)`), so a page can replace them on
dark screens. Text uses the page's font.
"""

from __future__ import annotations

import io
import re
import xml.etree.ElementTree as ElementTree

from matplotlib.figure import Figure

_NAMESPACE = re.compile(r"\{[^}]*\}")
_COLOR = re.compile(r"(fill|stroke): #([0-9a-f]{6})")
_REFERENCE = re.compile(r"url\(#([^)]+)\)")
_FAMILY = re.compile(r"font-family: [^;]*;?")
_LONG_DECIMAL = re.compile(r"(\.\d\d)\d+")


def inline(figure: Figure, name: str, label: str) -> str:
    """Return a figure as an <svg> element that can share a page with other figures.

    Its element IDs are prefixed with `name`, and it contains no style sheet.
    """
    file = io.BytesIO()
    metadata = dict.fromkeys(("Date", "Creator", "Format", "Type"))  # not needed, and has URLs of other servers
    figure.savefig(file, format="svg", transparent=True, metadata=metadata)
    root = ElementTree.fromstring(file.getvalue())
    for parent in root.iter():
        for child in list(parent):
            if _NAMESPACE.sub("", child.tag) == "style":  # it would apply to the whole page
                parent.remove(child)
    used = _references(root)
    for element in root.iter():
        element.tag = _NAMESPACE.sub("", element.tag)
        element.attrib = {
            key: value
            for key, value in (_rewritten(*item, name) for item in element.attrib.items())
            if key != "id" or value.removeprefix(f"{name}-") in used
        }
    root.attrib = {"viewBox": root.attrib["viewBox"], "role": "img", "aria-label": label}
    return ElementTree.tostring(root, encoding="unicode")


def _references(root: ElementTree.Element) -> set[str]:
    used = set()
    for element in root.iter():
        for key, value in element.attrib.items():
            if _NAMESPACE.sub("", key) == "href":
                used.add(value.removeprefix("#"))
            used.update(_REFERENCE.findall(value))
    return used


def _rewritten(key: str, value: str, name: str) -> tuple[str, str]:
    """Return an attribute as it appears on the page.

    Its XML namespace is removed, IDs are prefixed with the figure's name, and coordinates are truncated to hundredths
    of a point.
    """
    key = _NAMESPACE.sub("", key)
    if key == "id":
        return key, f"{name}-{value}"
    if key == "href":
        return key, f"#{name}-{value.removeprefix('#')}"
    value = _REFERENCE.sub(rf"url(#{name}-\1)", value)
    if key == "style":
        return key, _FAMILY.sub("", _COLOR.sub(r"\1: var(--c-\2, #\2)", value))
    if key in ("d", "points"):
        value = " ".join(value.split())
    return key, _LONG_DECIMAL.sub(r"\1", value) if key in ("d", "points", "x", "y", "transform") else value
