"""What is wrong with a stage: remembered as warnings, or raised at once where the caller is strict."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from pxr import Tf

from usdfab.errors import UsdfabError


class Problems:
    """Collects sentences about a stage.

    ``warnings`` holds what was left out or approximated. ``fault`` is for input that is plainly wrong: with ``strict``
    it raises, else it becomes a warning that says what is done instead. ``first`` is the first such fault.
    """

    def __init__(self, *, strict: bool = False) -> None:
        self.strict = strict
        self.warnings: list[str] = []
        self.first: UsdfabError | None = None

    def warn(self, *sentences: str) -> None:
        """Remember sentences, each once."""
        self.warnings += [s for s in dict.fromkeys(sentences) if s not in self.warnings]

    def fault(self, error: UsdfabError, instead: str) -> None:
        """Raise ``error`` if strict; else warn with it and with what is done ``instead`` ("the mesh is left out")."""
        if self.strict:
            raise error
        self.first = self.first or error
        text = f"{error.place}: {error.problem}" if error.place else error.problem
        self.warn(f"{text}; {instead}")

    @contextmanager
    def tolerating(self, place: str, instead: str) -> Iterator[None]:
        """A block whose errors are faults: ours, USD's own, and those of Python for values of the wrong type.

        ``place`` is named where the error names none.
        """
        try:
            yield
        except UsdfabError as error:
            self.fault(error, instead)
        except Tf.ErrorException as error:
            lines = str(error).strip().splitlines()
            reason = lines[-1].strip() if lines else "unreadable"
            self.fault(UsdfabError(f"USD cannot read it ({reason})", place=place), instead)
        except (TypeError, ValueError, OverflowError) as error:
            # USD hands out what a file holds, also where it is not of the schema's type: text for a number.
            self.fault(UsdfabError(f"a value is not what it should be ({error})", place=place), instead)
