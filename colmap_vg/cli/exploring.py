"""What the verb `view` does."""

from pathlib import Path

from colmap_vg.cli.jobs import configure_colmap_log
from colmap_vg.cli.reporter import Reporter
from colmap_vg.viewer.explorer import Explorer
from colmap_vg.viewer.finished_job import read_finished_job
from colmap_vg.viewer.guard import LOOPBACK
from colmap_vg.viewer.session import Session
from colmap_vg.viewer.window import show_window


def view(
    output_path: Path,
    image_path: Path | None,
    database_path: Path | None,
    lists_path: Path | None,
    backend: str,
    host: str,
    port: int,
    reporter: Reporter,
) -> None:
    """Explore a finished job in a browser or a window, until it is closed or interrupted."""
    configure_colmap_log(reporter.verbose)
    session = Session(read_finished_job(output_path, image_path, database_path))
    if backend == "open3d":
        show_window(session)
        return
    lists_path = lists_path or output_path.with_name(f"{output_path.absolute().name}_lists")
    explorer = Explorer(session, lists_path, host, port)
    if host not in LOOPBACK:
        reporter.warn(f"everyone who reaches {host} can see this job and write to {lists_path}")
    reporter.say(f"explorer: {explorer.url} (Ctrl-C ends it)")
    try:
        explorer.wait()
    except KeyboardInterrupt:
        reporter.say("explorer closed")
    finally:
        explorer.stop()
