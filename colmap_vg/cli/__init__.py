"""The command line: ``colmap-vg run``, ``mapper``, ``solve``, ``demo``.

Nothing heavy is imported before a verb runs, so that ``--help`` is quick.
"""
