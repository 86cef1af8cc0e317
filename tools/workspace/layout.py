"""Where things are in the workspace."""

from __future__ import annotations

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
VENV = ROOT / ".venv"
VENV_PYTHON = VENV / "bin" / "python"
REQUIREMENTS = ROOT / "requirements"

STATE = ROOT / ".workspace"
"""All that set-up makes beside the virtual environment."""
LOGS = STATE / "log"

PACKAGES = ("swarm_loc_msgs", "swarm_loc_estimator", "swarm_loc_vision", "swarm_loc_drivers")


class WorkspaceError(Exception):
    """Something stops the set-up or a start; its text is one sentence for a person."""
