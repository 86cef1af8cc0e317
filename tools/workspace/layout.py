"""Paths of the workspace."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
VENV = ROOT / ".venv"
VENV_PYTHON = VENV / "bin" / "python"
REQUIREMENTS = ROOT / "requirements"

STATE = ROOT / ".workspace"  # Folder of everything that set-up creates except the virtual environment
LOGS = STATE / "log"

PACKAGES = ("swarm_loc_msgs", "swarm_loc_estimator", "swarm_loc_vision", "swarm_loc_drivers")


class WorkspaceError(Exception):
    """The set-up or a start failed; the message is one sentence."""
