"""The explorer in a browser: pick images and pairs, mark them, solve again, compare, and save the lists."""

import shlex
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_vg.errors import ColmapVgError
from colmap_vg.scene.verdicts import EdgeVerdict, ImageVerdict
from colmap_vg.viewer.drawing import Drawing, drawing, side_by_side_shift
from colmap_vg.viewer.guard import guarded_server
from colmap_vg.viewer.pair_matches import pair_matches, picture
from colmap_vg.viewer.session import Session

BEFORE, AFTER, SIDE_BY_SIDE = "before", "after", "side by side"
MAX_FRUSTA = 2000
"""Maximum number of cameras drawn as frusta that can be clicked."""


class Explorer:
    """A server of the explorer's page, which one person at a time uses.

    Parameters
    ----------
    session : Session
    lists_path : Path
        Folder that the lists of pairs are saved to.
    host : str
        Address to listen on.
    port : int
        The first port that is tried; 0: any.

    Raises
    ------
    ViewerError
        The server cannot be started.
    """

    def __init__(self, session: Session, lists_path: Path, host: str = "127.0.0.1", port: int = 8080) -> None:
        self._session, self._lists_path, self._lock = session, lists_path, RLock()
        self._server = guarded_server(host, port, "colmap-vg")
        self._nodes: list[Any] = []
        self._image, self._pair = 0, -1
        names = session.job.graph.image_names
        self._labels = [f"{row + 1}: {printable(name)}" for row, name in enumerate(names)]
        self._look_at(drawing(session, session.before))
        self._build()
        self._choose_image(int(np.argmax(session.before.registered)))
        self._draw()

    def _look_at(self, drawn: Drawing) -> None:
        """Set where pages look from at first: from the side and above, at the middle of the cameras."""
        middle = drawn.centers.mean(axis=0) if len(drawn.centers) else np.zeros(3)
        extent = np.linalg.norm(np.ptp(drawn.centers, axis=0)) if len(drawn.centers) else 1.0
        camera = self._server.initial_camera
        camera.up, camera.look_at = (0.0, 0.0, 1.0), middle
        camera.position = middle + max(float(extent), 1e-6) * np.array([-0.45, -0.6, 0.6])

    @property
    def url(self) -> str:
        """Address of the page."""
        host = self._server.get_host()
        return f"http://{f'[{host}]' if ':' in host else host}:{self._server.get_port()}"

    def stop(self) -> None:
        """Stop the server."""
        self._server.stop()

    def wait(self) -> None:
        """Serve until interrupted."""
        self._server.sleep_forever()

    def _build(self) -> None:
        """Lay out the controls. Names are shown in text fields and menus only, never as markup."""
        gui = self._server.gui
        gui.configure_theme(show_logo=False, show_share_button=False, control_width="large")
        self._told = gui.add_text("Solution", "", multiline=True, disabled=True)
        with gui.add_folder("Image"):
            self._images = gui.add_dropdown("Image", self._labels, initial_value=self._labels[0])
            self._of_image = gui.add_text("Verdict", "", multiline=True, disabled=True)
            self._exclude_image = gui.add_button("Exclude image", hint="Use none of its pairs")
            self._restore_image = gui.add_button("Use image again")
        with gui.add_folder("Pair"):
            self._pairs = gui.add_dropdown("Pair with", ["-"])
            self._picture = gui.add_image(np.full((8, 8, 3), 255, np.uint8))
            self._of_pair = gui.add_text("Matches", "", multiline=True, disabled=True)
            self._exclude_pair = gui.add_button("Exclude pair", color="red")
            self._trust_pair = gui.add_button("Trust pair", color="green", hint="No filter may drop it")
            self._clear_pair = gui.add_button("No mark on pair")
        with gui.add_folder("Marks"):
            self._marks = gui.add_text("Marks", "none", multiline=True, disabled=True)
            self._solve = gui.add_button("Solve again", color="blue")
            self._clear = gui.add_button("Discard marks")
            self._save = gui.add_button("Save lists")
            self._saved = gui.add_text("Saved", "", multiline=True, disabled=True)
        with gui.add_folder("View"):
            self._shown = gui.add_dropdown("Show", [AFTER, BEFORE, SIDE_BY_SIDE])
            self._with_used = gui.add_checkbox("Pairs used", True)
            self._with_others = gui.add_checkbox("Pairs not used or marked", True)
            self._with_points = gui.add_checkbox("Points", True, hint="Of the job's model, beside the solution before")
        self._connect()

    def _connect(self) -> None:
        """Connect the controls to what they do, one at a time."""
        session = self._session
        actions = [
            (self._exclude_image, lambda: session.exclude_image(self._image)),
            (self._restore_image, lambda: session.exclude_image(self._image, False)),
            (self._exclude_pair, lambda: self._mark(session.exclude_pair)),
            (self._trust_pair, lambda: self._mark(session.trust_pair)),
            (self._clear_pair, lambda: self._mark(session.clear_pair)),
            (self._clear, session.clear),
        ]
        for button, action in actions:
            button.on_click(self._locked(action, self._tell))
        self._solve.on_click(self._locked(session.solve, self._tell, self._show_pair, self._draw))
        self._save.on_click(self._locked(self._save_lists))
        self._images.on_update(self._locked(self._image_chosen))
        self._pairs.on_update(self._locked(self._pair_chosen))
        for control in (self._shown, self._with_used, self._with_others, self._with_points):
            control.on_update(self._locked(self._draw))

    def _locked(self, *actions: Any) -> Any:
        """A callback that runs actions in turn, while no other callback runs."""

        def callback(_: Any) -> None:
            with self._lock:
                for action in actions:
                    action()

        return callback

    def _mark(self, mark: Any) -> None:
        if self._pair >= 0:
            mark(self._pair)

    def _image_chosen(self) -> None:
        row = self._labels.index(self._images.value)
        if row != self._image:
            self._choose_image(row)

    def _choose_image(self, image: int) -> None:
        """Show an image and list its pairs, those with most matches first."""
        graph = self._session.job.graph
        self._image = image
        if self._images.value != self._labels[image]:
            self._images.value = self._labels[image]
        pairs = np.flatnonzero((graph.edges == image).any(axis=1))
        if graph.num_inliers is not None:
            pairs = pairs[np.argsort(-graph.num_inliers[pairs], kind="stable")]
        self._pair_of = {self._pair_label(pair): pair for pair in pairs.tolist()}
        self._pair = int(pairs[0]) if len(pairs) else -1
        self._pairs.options = list(self._pair_of) or ["-"]
        self._pairs.value = self._pairs.options[0]
        self._tell()
        self._show_pair()

    def _choose_pair_with(self, image: int) -> None:
        """Show the pair of the chosen image with another one; if there is none, choose that image."""
        for label, pair in self._pair_of.items():
            if image != self._image and image in self._session.job.graph.edges[pair]:
                self._pairs.value = label
                self._pair = pair
                self._tell()
                self._show_pair()
                return
        self._choose_image(image)

    def _pair_label(self, pair: int) -> str:
        graph = self._session.job.graph
        i, j = graph.edges[pair].tolist()
        matches = "" if graph.num_inliers is None else f", {int(graph.num_inliers[pair])} matches"
        return f"{self._labels[j if i == self._image else i]}{matches}"

    def _pair_chosen(self) -> None:
        pair = self._pair_of.get(self._pairs.value, -1)
        if pair != self._pair:
            self._pair = pair
            self._tell()
            self._show_pair()

    def _show_pair(self) -> None:
        """Show the photographs and matches of the chosen pair."""
        if self._pair < 0:
            self._of_pair.value = "this image has no verified pair"
            return
        try:
            matches = pair_matches(self._session.job, self._session.after, self._pair)
        except ColmapVgError as error:
            self._of_pair.value = printable(str(error))
            return
        self._picture.image = picture(self._session.job, self._pair, matches)
        verdict = str(self._session.after.edge_verdicts[self._pair])
        self._of_pair.value = f"{verdict}: {EdgeVerdict.reason_of(verdict)}\n{matches.told()}"

    def _tell(self) -> None:
        """Update the texts on the solution, the image and the marks."""
        session, names = self._session, self._session.job.graph.image_names
        self._told.value = "\n".join(map(printable, session.told()))
        verdict = str(session.after.image_verdicts[self._image])
        mark = " It is marked as excluded." if session.excluded_images[self._image] else ""
        self._of_image.value = f"{verdict}: {ImageVerdict.reason_of(verdict)}.{mark}"
        lines = [f"exclude {printable(names[row])}" for row in np.flatnonzero(session.excluded_images)]
        for word, marked in (("exclude", session.excluded), ("trust", session.trusted)):
            lines += [
                f"{word} {printable(names[i])} - {printable(names[j])}"
                for i, j in session.job.graph.edges[marked].tolist()
            ]
        self._marks.value = "\n".join(lines) or "none"

    def _save_lists(self) -> None:
        try:
            excluded, trusted = self._session.save(self._lists_path)
        except ColmapVgError as error:
            self._saved.value = printable(str(error))
            return
        job = self._session.job
        command = ["colmap-vg", "mapper", "--database_path", str(job.database_path)]
        command += [] if job.image_path is None else ["--image_path", str(job.image_path)]
        command += ["--output_path", str(job.output_path.with_name(f"{job.output_path.name}_marked"))]
        command += ["--excluded_pairs_path", str(excluded), "--trusted_pairs_path", str(trusted)]
        self._saved.value = printable(shlex.join(command))

    def _draw(self) -> None:
        """Draw the solutions that are asked for."""
        with self._server.atomic():
            for node in self._nodes:
                node.remove()
            self._nodes = []
            before, after = (drawing(self._session, s) for s in (self._session.before, self._session.after))
            shown = self._shown.value
            if shown != AFTER:
                self._draw_solution("before", before, np.zeros(3))
            if shown != BEFORE:
                shift = side_by_side_shift(before, after) if shown == SIDE_BY_SIDE else np.zeros(3)
                self._draw_solution("after", after, shift)
            points = self._session.job.points
            if self._with_points.value and len(points):
                self._nodes.append(
                    self._server.scene.add_point_cloud(
                        "points",
                        points,
                        self._session.job.colors,
                        point_size=0.06 * before.depth,
                        point_shape="circle",
                        point_shading="flat",
                        precision="float32",
                    )
                )

    def _draw_solution(self, name: str, drawn: Drawing, shift: NDArray[np.float64]) -> None:
        scene = self._server.scene
        for row, image in enumerate(drawn.images[:MAX_FRUSTA].tolist()):
            x, y, z, w = pycolmap.Rotation3d(drawn.rotations[row]).quat
            frustum = scene.add_camera_frustum(
                f"{name}/camera{image}",
                float(drawn.fields_of_view[row]),
                float(drawn.aspects[row]),
                scale=drawn.depth,
                color=tuple(drawn.camera_colors[row].tolist()),
                wxyz=np.array([w, x, y, z]),
                position=drawn.centers[row] + shift,
            )
            frustum.on_click(self._locked(lambda chosen=image: self._choose_pair_with(chosen)))
            self._nodes.append(frustum)
        wanted = np.where(drawn.used, self._with_used.value, self._with_others.value)
        if wanted.any():
            self._nodes.append(
                scene.add_line_segments(
                    f"{name}/pairs",
                    (drawn.segments[wanted] + shift).astype(np.float32),
                    drawn.segment_colors[wanted],
                    thickness=0.05 * drawn.depth,
                )
            )


def printable(text: str) -> str:
    r"""Text on one line, with an escape in place of each character that cannot be seen.

    >>> printable("two\nlines")
    'two\\nlines'
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
