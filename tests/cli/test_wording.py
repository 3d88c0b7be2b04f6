"""Errors of the library name options, those of the command line flags."""

import pytest

from colmap_vg.cli.wording import with_flags


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("choose another output_path", "choose another --output_path"),
        ("go on with resume=True", "go on with --resume"),
        ("use matching='auto'", "use --matching auto"),
        ("lower num_threads or max_image_size", "lower --num_threads or --max_image_size"),
        ("no such file: /data/image_path/a.jpg", "no such file: /data/image_path/a.jpg"),
        ("image_path.db cannot be read", "image_path.db cannot be read"),
        ("found 'image_path'", "found 'image_path'"),
        ("the two_view_geometries table", "the two_view_geometries table"),
        ("--output_path is kept", "--output_path is kept"),
    ],
)
def test_options_become_flags_and_nothing_else_does(said, told):
    assert with_flags(said) == told
