"""``python -m colmap_vg`` is ``colmap-vg``."""

from colmap_vg.cli.main import main

if __name__ == "__main__":
    main()
