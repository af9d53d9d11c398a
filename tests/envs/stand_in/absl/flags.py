"""What of absl PySC2 needs to be told."""


class _Flags:
    def __init__(self) -> None:
        self._parsed = False

    def is_parsed(self) -> bool:
        return self._parsed

    def __call__(self, words: list[str]) -> None:
        assert words
        self._parsed = True


FLAGS = _Flags()
