"""Free memory of the machine, or of the container that it runs in."""

from pathlib import Path


def free_memory_bytes() -> float:
    """Memory that can be had: the machine's, or the container's where that is less; infinite where neither says."""
    return min(_available_bytes(), _container_bytes())


def _available_bytes() -> float:
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return 1024.0 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return float("inf")


def _container_bytes() -> float:
    """What a Linux control group leaves; file pages that it can drop count as free."""
    group = Path("/sys/fs/cgroup")
    try:
        limit, used = (float((group / name).read_text()) for name in ("memory.max", "memory.current"))
        of_files = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return limit - used + float(of_files.get("inactive_file", 0))
    except (OSError, ValueError):
        return float("inf")
