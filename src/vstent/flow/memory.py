"""Free memory of the machine or of the container that vstent runs in."""

from pathlib import Path


def free_memory_bytes() -> float:
    """Return the free memory of the machine or its container, whichever is less; infinite if both are unknown."""
    return min(_available_bytes(), _container_bytes())


def _available_bytes() -> float:
    """Return the machine's available memory, infinite where it is not known."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        return 1024.0 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable"))
    except (OSError, StopIteration):
        return float("inf")


def _container_bytes() -> float:
    """Return what a Linux control group has left, with its droppable file pages; infinite without a limit."""
    group = Path("/sys/fs/cgroup")
    try:
        limit, used = (float((group / name).read_text()) for name in ("memory.max", "memory.current"))
        of_files = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return limit - used + float(of_files.get("inactive_file", 0))
    except (OSError, ValueError):
        return float("inf")
