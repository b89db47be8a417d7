"""The examples in the docstrings. SPDX-License-Identifier: Apache-2.0"""
import doctest
import importlib
import pkgutil

import pytest

import roofgs

MODULES = ["roofgs", *(f"roofgs.{module.name}" for module in pkgutil.iter_modules(roofgs.__path__))]


@pytest.mark.parametrize("name", MODULES)
def test_examples(name, doctest_namespace, capsys):
    module = importlib.import_module(name)
    finder = doctest.DocTestFinder(exclude_empty=True)
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    n_examples = 0
    for test in finder.find(module, name, globs={}, extraglobs={**doctest_namespace, **vars(module)}):
        n_examples += len(test.examples)
        runner.run(test)
    assert runner.failures == 0, capsys.readouterr().out
    if name in ("roofgs", "roofgs._scene", "roofgs._render", "roofgs.cameras", "roofgs._errors"):
        assert n_examples > 1


def test_everything_public_has_a_docstring():
    for name in roofgs.__all__:
        thing = getattr(roofgs, name)
        if isinstance(thing, str):
            continue
        assert thing.__doc__, name
        members = getattr(thing, "__all__", [member for member in vars(thing) if not member.startswith("_")])
        for member in members:
            value = getattr(thing, member)
            if callable(value) or isinstance(value, property):
                assert value.__doc__, f"{name}.{member}"
