"""HTML pages of results: one file each, its pictures inside, so that it opens anywhere."""

from __future__ import annotations

import base64
from typing import Any

from dolfinopt.data import page_folders
from dolfinopt.study.tables import as_text


def html_page(template: str, **content: Any) -> str:
    """Return a page from a template of `data.page_folders`; what it names must be given."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    templates = Environment(
        loader=FileSystemLoader(page_folders()),
        autoescape=lambda name: str(name).endswith(".html"),
        undefined=StrictUndefined,
        trim_blocks=True,
    )
    return templates.get_template(template).render(as_text=as_text, **content).lstrip()


def embedded(data: bytes) -> dict[str, Any]:
    """Return a PNG as a page's macro `image` takes it."""
    width, height = (int.from_bytes(data[i : i + 4], "big") for i in (16, 20))  # of its header
    return {"data": base64.b64encode(data).decode(), "width": width, "height": height}
