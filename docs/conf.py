"""Configuration of the documentation site; `make docs` builds it.

Contract: neither building nor reading the site needs the network.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any

from docutils import nodes
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.ext.napoleon.docstring import GoogleDocstring
from sphinx.util.inspect import signature as signature_of
from sphinx.util.inspect import stringify_signature

import egoskin
from egoskin.runs.config import TrainConfig

project = "egoskin"
author = "The egoskin authors"
copyright = author
version = release = egoskin.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build"]
default_role = "py:obj"

# Headings are link targets, as on GitHub.
myst_heading_anchors = 3

autodoc_default_options = {
    "members": True,
    # Methods that TorchRL calls; every transform has them.
    "exclude-members": "compute, out_specs, start, advance, signal, measure",
}
autodoc_member_order = "bysource"
autodoc_typehints_format = "short"
autodoc_preserve_defaults = True
napoleon_numpy_docstring = False
napoleon_custom_sections = ["Source"]
# Names of other packages are not resolved: that would need the network.
nitpick_ignore_regex = [("py:.*", r"(?!egoskin).*")]

# Otherwise the text before a colon in the docstring of a field is taken as its type.
GoogleDocstring._parse_attribute_docstring = GoogleDocstring._consume_to_end
# Hide tyro's annotation of this field.
TrainConfig.__annotations__["env"] = "EnvConfig"

html_theme = "furo"
html_title = f"egoskin {version}"
html_show_sourcelink = False
html_copy_source = False

_BOUNDED = re.compile(
    r"Annotated\[(.+?), Interval\(gt=(.+?), ge=(.+?), lt=(.+?), le=(.+?)\)\]"
)


def _interval(match: re.Match[str]) -> str:
    """Return a type with the interval of its values, as "float in [0, 1]"."""
    kind, gt, ge, lt, le = match.groups()
    low = f"[{ge}" if ge != "None" else f"({gt}" if gt != "None" else "(-inf"
    high = f"{le}]" if le != "None" else f"{lt})" if lt != "None" else "inf)"
    return f"{kind} in {low}, {high}"


def shorten_types(app: Sphinx, doctree: nodes.document) -> None:
    """Show the types of bounded fields as "float in [0, 1]"."""
    for node in doctree.findall(addnodes.desc_annotation):
        text = node.astext()
        if "Annotated[" in text:
            text = _BOUNDED.sub(_interval, text)
            node[:] = [nodes.Text(text)]


def mend_signature(
    app: Sphinx, what: str, name: str, obj: Any, options: Any, signature: str, *_: Any
) -> Any:
    """Return the signature to show for a class, or None to keep it.

    That of a dataclass is left out, because its fields are documented one by one.
    TorchRL's metaclass hides the signature of a transform: take that of ``__init__``.
    """
    if what == "class" and dataclasses.is_dataclass(obj):
        return ("", None)
    if what == "class" and signature == "(*args, **kwargs)":
        own = signature_of(obj.__init__, bound_method=True)
        own = own.replace(return_annotation=own.empty)
        return stringify_signature(own, unqualified_typehints=True), None
    return None


def find_alias(app: Sphinx, env: Any, node: Any, content: nodes.Element) -> Any:
    """Resolve a name that a package re-exports to the module that documents it."""
    target = node.get("reftarget", "")
    package, _, name = target.rpartition(".")
    domain = env.domains.python_domain
    found = [
        known
        for known in domain.objects
        if package and known.startswith(f"{package}.") and known.endswith(f".{name}")
    ]
    if node.get("refdomain") != "py" or len(found) != 1:
        return None
    return domain.resolve_xref(
        env, node["refdoc"], app.builder, "obj", found[0], node, content
    )


def setup(app: Sphinx) -> None:
    """Register the functions above with Sphinx."""
    app.connect("doctree-read", shorten_types)
    app.connect("autodoc-process-signature", mend_signature)
    app.connect("missing-reference", find_alias)
