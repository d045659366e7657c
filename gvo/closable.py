"""What is closed at the end of a `with` block."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self


class Closable(ABC):
    """A thing that is used inside a `with` block and closed at its end, also after an error."""

    @abstractmethod
    def close(self) -> None:
        """Finish."""

    def __enter__(self) -> Self:
        """Return the thing, open."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close it."""
        self.close()
