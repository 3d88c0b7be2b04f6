"""Lines on the events of a job, for scripts that take the place of other programs'."""

import sys

from colmap_vg.events import StageEvent


def show_stages(event: StageEvent) -> None:
    """Print each finished stage, and warnings."""
    if event.state == "finished":
        print(f"{event.stage}: {event.message} ({event.seconds:.1f} s)", flush=True)
    show_warnings(event)


def show_warnings(event: StageEvent) -> None:
    """Print warnings only, on standard error."""
    if event.state == "warning":
        print(f"warning: {event.message}", file=sys.stderr)
