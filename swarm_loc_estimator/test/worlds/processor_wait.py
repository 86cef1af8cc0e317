"""How long others kept a process or thread from running: not its fault on a busy machine."""

from pathlib import Path

THIS_THREAD = "thread-self"


def waited_s(task: int | str) -> float:
    """How long a process, by its number, or THIS_THREAD could have run but had to wait."""
    return int(Path("/proc", str(task), "schedstat").read_text(encoding="ascii").split()[1]) * 1e-9
