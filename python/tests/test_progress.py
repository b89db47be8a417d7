"""Progress bars. SPDX-License-Identifier: Apache-2.0"""
import io
import sys
import types

import pytest

from roofgs import _progress


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_lines():
    assert _progress.Bar.line("encode", 500, 1000, "Gaussians") == \
        "encode       [============            ]  50%  500 Gaussians"
    assert _progress.Bar.line("read", 3_000_000, 3_000_000, "B").endswith("[========================] 100%  3.0 MB")
    assert _progress.Bar.line("sort", 0, 0, "") == "sort"
    assert "[========================] 100%" in _progress.Bar.line("more", 12, 10, "")


def drawn(monkeypatch, stream):
    monkeypatch.setattr(sys, "stderr", stream)
    clock = iter(range(100))
    monkeypatch.setattr(_progress.time, "monotonic", lambda: float(next(clock)))
    with _progress.Reporting(True) as callback:
        callback("encode", 1, 4, "pages")
        callback("encode", 4, 4, "pages")
    return stream.getvalue()


def test_a_terminal_has_one_line_that_goes(monkeypatch):
    text = drawn(monkeypatch, Terminal())
    assert text.count("\r") == 3 and "25%" in text and "100%" in text and "\n" not in text
    assert text.endswith("\r\x1b[K")


def test_a_log_stays_clean(monkeypatch):
    assert drawn(monkeypatch, io.StringIO()) == ""


def test_a_notebook_has_one_output(monkeypatch):
    shown = []

    class Handle:
        def update(self, data, raw):
            shown.append(data["text/plain"])

    def display(data, raw, display_id):
        assert raw and display_id
        shown.append(data["text/plain"])
        return Handle()

    class ZMQInteractiveShell:
        pass

    ipython = types.ModuleType("IPython")
    ipython.get_ipython = ZMQInteractiveShell
    ipython.display = types.ModuleType("IPython.display")
    ipython.display.display = display
    monkeypatch.setitem(sys.modules, "IPython", ipython)
    monkeypatch.setitem(sys.modules, "IPython.display", ipython.display)
    assert drawn(monkeypatch, io.StringIO()) == ""
    assert len(shown) == 3 and "25%" in shown[0] and "100%" in shown[1] and shown[2] == ""


def test_what_progress_may_be():
    calls = []
    with _progress.Reporting(lambda *facts: calls.append(facts)) as callback:
        callback("a", 1, 2, "B")
    assert calls == [("a", 1, 2, "B")]
    for nothing in (None, False):
        with _progress.Reporting(nothing) as callback:
            assert callback is None
    with pytest.raises(TypeError):
        _progress.Reporting(3)
