"""The library's default method beside the paper's: errors over the images of both, and times of all chains."""

from collections.abc import Mapping, Sequence

import numpy as np

from paper.markdown import markdown_table
from paper.position_table import DEFAULT_METHOD, MethodErrors, median_over_seeds


def default_table(rows: Sequence[MethodErrors]) -> str:
    """Markdown: the default method's errors on each set beside the least of the other methods' over the same images.

    Parameters
    ----------
    rows : sequence of MethodErrors
        Of all sets, seeds and methods. Sets without the default, or without another method, are left out.

    Returns
    -------
    str
        A line for each set, the smaller error bold, and a sentence that counts them.
    """
    middle = median_over_seeds(rows)
    table = []
    num_accurate = num_complete = 0
    for dataset in dict.fromkeys(row.dataset for row in middle):
        default = [row for row in middle if row.dataset == dataset and row.method == DEFAULT_METHOD]
        others = [row for row in middle if row.dataset == dataset and row.method != DEFAULT_METHOD]
        if not default or not others:
            continue
        ours, best = default[0], min(others, key=lambda row: row.shared_median)
        num_accurate += ours.shared_median <= best.shared_median
        num_complete += ours.num_images >= best.num_images
        least = min(ours.shared_median, best.shared_median)
        errors = [
            f"**{row.shared_median:.3g}**" if row.shared_median == least else f"{row.shared_median:.3g}"
            for row in (ours, best)
        ]
        table.append([dataset.replace("_", " "), str(ours.num_images), str(best.num_images), *errors, best.method])
    header = ["set", "n, default", "n, paper's chain", "median, default", "least median of the others", "by"]
    return (
        f"{markdown_table(header, table)}\nThe default is at least as accurate on {num_accurate} of {len(table)} sets,"
        f" and registers no fewer images on {num_complete}.\n"
    )


def times_table(
    rows: Sequence[MethodErrors],
    num_edges: Mapping[str, int],
    averaging_seconds: Mapping[tuple[str, int], float],
) -> str:
    """Markdown: seconds of each method's whole chain over those of pycolmap's rotation averaging.

    Parameters
    ----------
    rows : sequence of MethodErrors
        Of all sets, seeds and methods.
    num_edges : mapping of set to int
    averaging_seconds : mapping of (set, seed) to float
        Of pycolmap's rotation averaging of the same graph.

    Returns
    -------
    str
        A line for each set: medians over seeds, of the seconds and of the ratios.
    """
    methods = list(dict.fromkeys(row.method for row in rows))
    table = []
    for dataset in dict.fromkeys(row.dataset for row in rows):
        seconds = np.median([value for (name, _), value in averaging_seconds.items() if name == dataset])
        line = [dataset.replace("_", " "), str(num_edges[dataset]), f"{seconds:.3g}"]
        for method in methods:
            ratios = [
                row.seconds / averaging_seconds[dataset, row.seed]
                for row in rows
                if row.dataset == dataset and row.method == method
            ]
            line.append(f"{np.median(ratios):.2g}" if ratios else "")
        table.append(line)
    names = ["default" if method == DEFAULT_METHOD else method for method in methods]
    return markdown_table(["set", "edges", "pycolmap, s", *names], table)
