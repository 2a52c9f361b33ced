"""A text in Markdown with tables and figures, as one self-contained HTML page."""

from __future__ import annotations

import base64
import html
import re
from collections.abc import Sequence
from pathlib import Path

from markdown import markdown

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto;
  padding: 0 1rem; color: #222; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: 13px; }
th, td { padding: .25rem .6rem; border-bottom: 1px solid #ddd; text-align: left;
  vertical-align: top; }
th { background: #f4f4f4; }
figure { margin: 1.5rem 0; } figure img { max-width: 100%; }
figcaption { color: #555; font-size: 13px; }
"""
# A picture and its caption, as `markdown` writes them.
_FIGURE = re.compile(
    r'<p><img alt="[^"]*" src="([^"]*)\.png" /></p>\s*<p><em>(.*?)</em></p>'
)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    cells = [[x.replace("|", "\\|") for x in line] for line in lines]
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def page(title: str, text: str, folder: Path) -> str:
    """Return a text in Markdown as one self-contained HTML page.

    Args:
        title: Title of the page.
        text: The text.
        folder: Folder of the saved figures.
    """

    def embed(found: re.Match[str]) -> str:
        name, caption = found.groups()
        data = base64.b64encode((folder / f"{name}.svg").read_bytes()).decode()
        return (
            f'<figure><img alt="{caption}" src="data:image/svg+xml;base64,{data}">'
            f"<figcaption>{caption}</figcaption></figure>"
        )

    body = markdown(html.escape(text, quote=False), extensions=["tables"])
    body = _FIGURE.sub(embed, body)
    body = body.replace("<table>", '<div class="wide"><table>')
    body = body.replace("</table>", "</table></div>")
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html.escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n"
        f"<body>\n{body}\n</body>\n</html>\n"
    )
