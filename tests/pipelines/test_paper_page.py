"""The page about the paper names functions that exist."""

import importlib
import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "paper.md"


def test_every_function_that_the_page_names_exists():
    names = re.findall(r"`(colmap_vg\.[\w.]+)`", PAGE.read_text(encoding="utf-8"))
    assert len(names) > 15
    for name in names:
        module, attribute = name.rsplit(".", 1)
        assert callable(getattr(importlib.import_module(module), attribute)), name
