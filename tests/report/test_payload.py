"""JSON inside a script element."""

import json

from report_outputs import HOSTILE_NAMES

from colmap_vg.report.payload import script_json


def test_no_character_has_a_meaning_in_html() -> None:
    names = [*HOSTILE_NAMES, "</script>", "<!--", "]]>", "&lt;", "\u2028\u2029", "\udcff"]
    text = script_json(names)
    assert text.isascii()
    assert not set("<>&") & set(text)
    assert json.loads(text) == names
