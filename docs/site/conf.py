"""How Sphinx builds the site. `build.py` calls it, and writes what it reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx import addnodes
from sphinx.application import Sphinx
from sphinx.transforms import SphinxTransform

from jaximp import __version__

project = "jaximp"
author = "the jaximp authors"
project_copyright = f"{author}, Apache-2.0"
version = release = __version__

extensions = ["myst_parser"]
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
# Text stays as it was written.
smartquotes = False

html_theme = "furo"
html_title = f"jaximp {__version__}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_show_sourcelink = False
# Excerpts are fetched, which a browser refuses for files: the search would stop at the first.
html_show_search_summary = False
html_copy_source = False
maximum_signature_line_length = 88
add_module_names = False
toc_object_entries_show_parents = "hide"


class NamesBecomeLinks(SphinxTransform):
    """A public name between backticks leads to its entry."""

    default_priority = 500

    def apply(self, **kwargs: Any) -> None:
        links = self.app.config.jaximp_links
        for literal in list(self.document.findall(nodes.literal)):
            target = links.get(literal.astext().removesuffix("()"))
            inside = (nodes.reference, nodes.title, addnodes.pending_xref, addnodes.desc_signature)
            if target is None or isinstance(literal.parent, inside):
                continue
            link = addnodes.pending_xref("", refdomain="py", reftype="obj", reftarget=target, refwarn=True)
            link["refdoc"] = self.env.docname
            literal.replace_self(link)
            link += literal


def formula(translator: Any, node: nodes.Element) -> None:
    """As MathML, which browsers draw themselves: MathJax would come from another host."""
    translator.body.append(tex2mathml(node.astext(), as_block=isinstance(node, nodes.math_block)))
    raise nodes.SkipNode


def read_names(app: Sphinx, config: Any) -> None:
    """What `build.py` found in the code."""
    config.jaximp_links = json.loads((Path(app.srcdir) / "names.json").read_text(encoding="utf-8"))


def setup(app: Sphinx) -> None:
    app.add_config_value("jaximp_links", {}, "env", [dict])
    app.connect("config-inited", read_names)
    app.add_transform(NamesBecomeLinks)
    app.add_html_math_renderer("mathml", inline_renderers=(formula, None), block_renderers=(formula, None))
