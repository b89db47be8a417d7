"""Progress of a long call: the caller's function, or a bar in a terminal or notebook."""
# SPDX-License-Identifier: Apache-2.0
from __future__ import annotations

import sys
import time
from typing import Any, Callable, Optional, Union

#: Called with the stage's name, units done, units in all (0: unknown) and the unit ("B": bytes).
Callback = Callable[[str, int, int, str], None]
Progress = Union[None, bool, Callback]

_WIDTH = 24


def _amount(units: float, unit: str) -> str:
    for factor, prefix in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if units >= factor:
            return f"{units / factor:.1f} {prefix}{unit}" if unit == "B" else f"{units / factor:.1f}{prefix} {unit}"
    return f"{units:.0f} {unit}".rstrip()


class Bar:
    """Draws the current stage on one line of standard error or of a notebook cell. Silent in logs and pipes."""

    def __init__(self) -> None:
        self._notebook: Any = _notebook_display()
        self._terminal = sys.stderr is not None and sys.stderr.isatty()
        self._drawn = False
        self._next = time.monotonic() + 0.2  # short stages show nothing

    def __call__(self, stage: str, done: int, total: int, unit: str) -> None:
        now = time.monotonic()
        if now < self._next or not (self._notebook or self._terminal):
            return
        self._next = now + 0.1
        self._draw(self.line(stage, done, total, unit))

    @staticmethod
    def line(stage: str, done: int, total: int, unit: str) -> str:
        if total <= 0:
            return f"{stage:<12} {_amount(done, unit)}" if done else stage
        part = min(done / total, 1.0)
        filled = int(part * _WIDTH)
        return f"{stage:<12} [{'=' * filled}{' ' * (_WIDTH - filled)}] {100 * part:3.0f}%  {_amount(done, unit)}"

    def _draw(self, line: str) -> None:
        if self._notebook:
            self._notebook.update(line)
        else:
            sys.stderr.write(f"\r{line}\x1b[K")
            sys.stderr.flush()
        self._drawn = True

    def close(self) -> None:
        if self._drawn and not self._notebook:
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
        elif self._drawn:
            self._notebook.update("")
        self._drawn = False


class _Line:
    """One line of a notebook cell, rewritten in place."""

    def __init__(self, display: Any) -> None:
        self._display = display
        self._handle: Any = None

    def update(self, text: str) -> None:
        data = {"text/plain": text}
        if self._handle is None:
            self._handle = self._display(data, raw=True, display_id=True)
        else:
            self._handle.update(data, raw=True)


def _notebook_display() -> Optional[_Line]:
    ipython: Any = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    if shell is None or type(shell).__name__ != "ZMQInteractiveShell":
        return None
    return _Line(sys.modules["IPython.display"].display)


class Reporting:
    """The callback for `progress`: True is a bar, None or False is silence."""

    def __init__(self, progress: Progress) -> None:
        self._bar = Bar() if progress is True else None
        self.callback: Optional[Callback] = self._bar
        if callable(progress):
            self.callback = progress
        elif progress not in (None, False, True):
            raise TypeError(f"progress is True, False or a function, not {type(progress).__name__}")

    def __enter__(self) -> Optional[Callback]:
        return self.callback

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.close()
