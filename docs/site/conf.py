# conf.py - how Sphinx makes the site of scripts/site.sh, which names the folders.
# SPDX-License-Identifier: Apache-2.0
import os
import sys

from docutils.nodes import reference
from sphinx.addnodes import download_reference

project = "RoofGS"
project_copyright = "the authors of RoofGS, Apache-2.0"
extensions = ["myst_parser", "sphinx.ext.autodoc", "numpydoc", "breathe"]
exclude_patterns = ["docs/site/*"]
language = "en"
smartquotes = False  # options begin with --

# Anchors of headings as on code hosts.
myst_heading_anchors = 4

sys.path.insert(0, os.environ["RGS_SITE_PYTHON"])
numpydoc_show_class_members = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # docstrings have them, with shapes

breathe_projects = {"rgs": os.environ["RGS_SITE_XML"]}
breathe_default_project = "rgs"
breathe_show_include = False
cpp_id_attributes = ["RGS_API", "RGS_HD"]

html_theme = "furo"
html_title = "RoofGS"
html_copy_source = False
html_show_sourcelink = False
html_show_sphinx = False
html_static_path = ["site.css"]
html_css_files = ["site.css"]
# In both schemes: the style sheet has bold and italic code alone.
pygments_style = pygments_dark_style = "bw"
highlight_language = "none"
# The colours of the audit's report.
html_theme_options = {
    "light_css_variables": {
        "color-background-primary": "#fff", "color-background-secondary": "#f6f6f3", "color-foreground-primary": "#1b1f24",
        "color-foreground-secondary": "#5b6470", "color-background-border": "#dfe1dd", "color-code-background": "#eef2f6",
        "color-brand-primary": "#2b6cb0", "color-brand-content": "#2b6cb0", "color-problematic": "#2b6cb0",
    },
    "dark_css_variables": {
        "color-background-primary": "#1c2024", "color-background-secondary": "#14171a", "color-foreground-primary": "#e8eaec",
        "color-foreground-secondary": "#9aa4af", "color-background-border": "#30363c", "color-code-background": "#23292f",
        "color-brand-primary": "#7db4ec", "color-brand-content": "#7db4ec", "color-problematic": "#7db4ec",
    },
}


def link_pages(app, doctree):
    """Links to pages that are in the repository, where Sphinx would link to a copy beside nothing that they link to."""
    for node in list(doctree.findall(download_reference)):
        if node["reftarget"].endswith(".html"):
            node.replace_self(reference("", "", *node.children, refuri=node["reftarget"], internal=True))


def setup(app):
    app.connect("doctree-read", link_pages, priority=1)
