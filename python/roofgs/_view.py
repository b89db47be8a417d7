"""The viewer's page in a notebook."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import base64
import html
import json
import os
import tempfile
from pathlib import Path
from typing import Union

from ._errors import argument_error, local_name, make
from ._scene import Scene, StreamedScene

_PAGE = Path(__file__).parent / "share/roofgs/viewer/single.html"
_MARK = "<!-- rgs-view:insert -->"


class View:
    """The viewer's page with a scene in it. A notebook shows it.

    Attributes
    ----------
    page : str
        The page, which needs nothing else, for a file of one's own.
    height : int
        Of the notebook's frame, pixels.
    """

    def __init__(self, page: str, height: int) -> None:
        self.page = page
        self.height = height

    def _repr_html_(self) -> str:
        return (f'<iframe srcdoc="{html.escape(self.page)}" width="100%" height="{self.height:d}" style="border:0" '
                'allow="fullscreen"></iframe>')


def view(scene: Union[Scene, StreamedScene], *, height: int = 540) -> View:
    """Shows a scene in a notebook's cell, to look around in it: all of its bytes are in the notebook then, a third larger.
    A streamed scene is the file that it reads. UnavailableError where the package has no page, as one that was built without it.
    """
    if not _PAGE.exists():
        raise make("unavailable", "this package was built without the viewer's page: run scripts/build_page.sh before it is made")
    if isinstance(scene, StreamedScene):
        data = Path(os.fsdecode(local_name(scene._path))).read_bytes()
    elif isinstance(scene, Scene):
        with tempfile.TemporaryDirectory(prefix="roofgs-") as folder:
            scene.save(os.path.join(folder, "scene.rgs"), sync=False)
            data = Path(folder, "scene.rgs").read_bytes()
    else:
        raise argument_error(f"scene is a roofgs.Scene or StreamedScene, not {type(scene).__name__}")
    facts = {"version": 1, "scenes": [{"name": "scene.rgs", "url": "#rgs-file-0", "bytes": len(data)}], "cameras": None, "photos": [],
             "frames": None}
    inside = (f'<script type="application/json" id="rgs-view">{json.dumps(facts)}</script>\n'
              f'<script type="application/octet-stream;base64" id="rgs-file-0">{base64.b64encode(data).decode()}</script>\n')
    # Its bytes as they are: the page states the hash of its script.
    return View(_PAGE.read_bytes().decode().replace(_MARK, inside), height)
