"""What holds something open until its ``with`` statement ends."""

from abc import ABC, abstractmethod
from types import TracebackType
from typing import TypeVar

S = TypeVar("S", bound="Closing")


class Closing(ABC):
    """Use it in a ``with`` statement, or call `close`."""

    @abstractmethod
    def close(self) -> None:
        """Gives back what is held."""

    def __enter__(self: S) -> S:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
