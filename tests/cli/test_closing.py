"""The lines at a job's end."""

from pathlib import Path

from colmap_vg.cli.closing import closing_lines


def _summary(left_out, status="partial", **agreement):
    model = {"path": "out/0", "num_images": 7, "num_points": 123, "mean_reprojection_error_px": 0.456}
    model["agreement"] = {"inliers": 0.9876, "pairs": 0.54, **agreement}
    images = {"num_images": 7 + len(left_out), "left_out": left_out}
    return {"status": status, "images": images, "models": [model]}


def test_a_whole_model_takes_one_line():
    lines = closing_lines(_summary({}, "solved"), Path("out"))
    assert lines == [
        "out/0: 7 of 7 images, 123 points, mean reprojection error 0.46 px, 98.8 % of the matches and 54 % of the"
        " pairs agree"
    ]


def test_the_most_frequent_reasons_are_told_with_names():
    left_out = {f"{n}.jpg": "cut_off" for n in "dabc"} | {"x.txt": "not a photograph", "y": "no_edges"}
    left_out |= {"z\n": "no_edges", "u": "uncertain"}
    lines = closing_lines(_summary(left_out), Path("out"))
    assert "7 of 15 images" in lines[0]
    assert lines[1].startswith("4 left out (a.jpg, b.jpg, c.jpg, ...): all edges")
    assert lines[2] == r"2 left out (y, 'z\n'): no verified pair of this image could be used"
    assert lines[3] == "1 left out (x.txt): not a photograph"
    assert lines[4:] == ["1 left out for 1 other reason", "all reasons: colmap-vg explain --output_path out"]


def test_a_doubtful_model_is_called_so():
    assert any(
        line.startswith("doubtful: the model may be folded")
        for line in closing_lines(_summary({}, "doubtful"), Path("o"))
    )
