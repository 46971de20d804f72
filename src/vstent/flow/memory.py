"""Free memory of the machine or of the container that vstent runs in."""

from contextlib import suppress
from pathlib import Path


def free_memory_bytes() -> float:
    """Return the free memory of the machine or its container, whichever is less; infinite if both are unknown."""
    free = [float("inf")]
    with suppress(OSError, StopIteration):
        lines = Path("/proc/meminfo").read_text(encoding="utf-8").splitlines()
        free.append(1024.0 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable")))
    with suppress(OSError, ValueError):  # no control group, or one without a limit
        group = Path("/sys/fs/cgroup")
        limit, used = (float((group / name).read_text(encoding="utf-8")) for name in ("memory.max", "memory.current"))
        of_files = dict(line.split() for line in (group / "memory.stat").read_text(encoding="utf-8").splitlines())
        free.append(limit - used + float(of_files.get("inactive_file", 0)))  # file pages can be dropped
    return min(free)
