"""How many matches of a database fit into memory: a huge one is thinned or refused before the kernel steps in."""

import resource
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]

BYTES_PER_MATCH = 700
"""Peak of reading and solving, measured on three sets: 400 to 680."""
BYTES_PER_MATCH_IN_COLMAP = 60
"""Of COLMAP's matches and correspondence graph, which hold all of a database's matches."""
USABLE_SHARE = 0.7
"""Of the memory that is free; other processes and what is built on the matches need the rest."""
MIN_MATCHES_PER_PAIR = 50
"""Fewer say too little of a pair to be a fair sample."""

_MEMINFO = Path("/proc/meminfo")
_CGROUPS = (
    (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")),
    (Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"), Path("/sys/fs/cgroup/memory/memory.usage_in_bytes")),
)


def available_memory() -> float:
    """Bytes that this process may still take, by the machine, its control group and its own limit; else infinite."""
    found = [np.inf]
    for line in _text(_MEMINFO).splitlines():
        if line.startswith("MemAvailable:"):
            found.append(1024.0 * int(line.split()[1]))
    for limit, usage in _CGROUPS:
        numbers = _text(limit).strip(), _text(usage).strip()
        if all(number.isdigit() for number in numbers):
            found.append(float(numbers[0]) - float(numbers[1]))
    limit_of_addresses, _ = resource.getrlimit(resource.RLIMIT_AS)
    used = _text(Path("/proc/self/statm")).split()
    if limit_of_addresses != resource.RLIM_INFINITY and used:
        found.append(float(limit_of_addresses) - int(used[0]) * resource.getpagesize())
    return max(min(found), 0.0)


def affordable_matches_per_pair(num_matches: IntArray, memory: float) -> int | None:
    """Matches that each pair may keep.

    Parameters
    ----------
    num_matches : (m,) int array
        Of each pair.
    memory : float
        Bytes that are free.

    Returns
    -------
    int or None
        0 when all fit; None when not even the fewest that are of use do, or when COLMAP could not hold them all.
    """
    total, budget = float(num_matches.sum()), USABLE_SHARE * memory
    if total * BYTES_PER_MATCH <= budget:
        return 0
    if total * BYTES_PER_MATCH_IN_COLMAP > budget:
        return None
    # With n sorted, a cap of n_k costs n_1 + ... + n_k + (m - k) n_k matches: rising in k.
    ordered = np.sort(num_matches)
    before = np.concatenate([[0], np.cumsum(ordered)])[:-1]
    cost = before + (len(ordered) - np.arange(len(ordered))) * ordered
    k = int(np.searchsorted(cost * BYTES_PER_MATCH, budget, side="right"))
    cap = int((budget / BYTES_PER_MATCH - before[k]) / (len(ordered) - k))
    return cap if cap >= MIN_MATCHES_PER_PAIR else None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii")
    except OSError:
        return ""
