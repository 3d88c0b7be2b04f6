"""The command line: ``colmap-vg run``, ``mapper``, ``solve``, ``demo``, ``explain``, ``report``.

Nothing heavy is imported before a verb runs, so that ``--help`` is quick.
"""
