"""What is wrong with a robot now, about each of its frames and kinds of message, and since when."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from datetime import UTC, datetime

_ABOUT_MAX = 16
_TEXT_MAX = 500
_FRESH_S = 10.0


@dataclass(slots=True)
class _Trouble:
    text: str
    since_unix_s: float
    last_unix_s: float


@dataclass(slots=True)
class Troubles:
    """At most a handful, each about one thing; what is well again is cleared."""

    _known: dict[str, _Trouble] = field(default_factory=dict)

    def note(self, about: str, text: str, unix_s: float) -> None:
        """Note what is wrong; the time at which it began to go wrong is kept.

        Args:
            about: a frame, or a kind of message.
            text: a sentence; long ones are cut, as names in them are a robot's.
            unix_s: now.
        """
        text = text[:_TEXT_MAX]
        known = self._known.get(about)
        if known is not None:
            known.text, known.last_unix_s = text, unix_s
        elif len(self._known) < _ABOUT_MAX:
            self._known[about] = _Trouble(text, unix_s, unix_s)

    def clear(self, about: str) -> None:
        """Note that it is well again."""
        self._known.pop(about, None)

    def forget(self, abouts: Iterable[str], unix_s: float) -> None:
        """Clear those of these that did not come again for a while."""
        for about in abouts:
            known = self._known.get(about)
            if known is not None and unix_s - known.last_unix_s > _FRESH_S:
                self.clear(about)

    def told(self) -> str | None:
        """Give all of it for people, the oldest first; None when nothing is wrong."""
        return "; ".join(map(_told, self._known.values())) or None


def _told(trouble: _Trouble) -> str:
    since = datetime.fromtimestamp(trouble.since_unix_s, UTC)
    return f"{trouble.text}, since {since:%Y-%m-%dT%H:%M:%SZ}"
