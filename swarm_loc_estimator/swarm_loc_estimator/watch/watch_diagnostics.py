"""What the page's node says of itself on /diagnostics: pages, slow ones, messages that it could not use."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from swarm_loc_estimator.watch.server import ServerLoad


class WatchDiagnostics:
    """Makes one status after the other; what has grown since the last one is a warning.

    Args:
        name: Of the node.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._known: Counter[str] = Counter()

    def status(self, load: ServerLoad, drops: Mapping[str, int]) -> DiagnosticStatus:
        """The status.

        Args:
            load: Of the server.
            drops: Topic and reason -> messages that were dropped so far.
        """
        grown = Counter(drops) - self._known
        self._known = Counter(drops)
        said = [f"{count} dropped: {what}" for what, count in grown.items()]
        if load.slow:
            said.append(f"{load.slow} slow")
        values = {
            "pages": load.pages,
            "slow pages": load.slow,
            "frames left out for slow pages": load.left_out,
            "texts left out for slow pages": load.texts_left_out,
            "pages refused": load.refused,
        }
        values |= {f"dropped: {what}": count for what, count in sorted(drops.items())}
        return DiagnosticStatus(
            level=DiagnosticStatus.WARN if said else DiagnosticStatus.OK,
            name=self._name,
            message=", ".join([f"{load.pages} pages", *said]),
            values=[KeyValue(key=key, value=str(value)) for key, value in values.items()],
        )
