"""Limit the number of matches to what fits into memory, before the kernel kills the process."""

import resource
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]

BYTES_PER_MATCH = 700
"""Peak memory of reading and solving per match, bytes; measured 400 to 680 on three sets."""
BYTES_PER_MATCH_IN_COLMAP = 60
"""Bytes per match of COLMAP's matches and correspondence graph, which hold all matches of a database."""
USABLE_SHARE = 0.7
"""Share of the free memory to use; other processes and the data built from the matches need the rest."""
MIN_MATCHES_PER_PAIR = 50
"""Minimum number of matches per pair after sampling; fewer are not representative of the pair."""

_MEMINFO = Path("/proc/meminfo")
_CGROUPS = (
    (Path("/sys/fs/cgroup/memory.max"), Path("/sys/fs/cgroup/memory.current")),
    (Path("/sys/fs/cgroup/memory/memory.limit_in_bytes"), Path("/sys/fs/cgroup/memory/memory.usage_in_bytes")),
)


def available_memory() -> float:
    """Memory that this process can still allocate, bytes; infinite if unknown.

    It is the least that the machine, the control group and the process's own limit leave.
    """
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
    """Maximum number of matches per pair that fits into memory.

    Parameters
    ----------
    num_matches : (m,) int array
        Number of matches of each pair.
    memory : float
        Free memory, bytes.

    Returns
    -------
    int or None
        0 if all matches fit; None if the maximum is below `MIN_MATCHES_PER_PAIR`, or COLMAP could not hold all matches.
    """
    total, budget = float(num_matches.sum()), USABLE_SHARE * memory
    if total * BYTES_PER_MATCH <= budget:
        return 0
    if total * BYTES_PER_MATCH_IN_COLMAP > budget:
        return None
    # With n sorted, a cap of n_k keeps n_1 + ... + n_k + (m - k) n_k matches, which increases with k.
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
