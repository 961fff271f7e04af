"""What the commands share: numbers as options, silence, progress bars."""

import argparse
import contextlib
import io
import math
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

EXTRA = "pip install 'blastjax[cli]'"


class Command(NamedTuple):
    """A command of the command line."""

    help: str
    options: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace, argparse.ArgumentParser], int]


def whole(least: int) -> Callable[[str], int]:
    """Return a reader of whole numbers from the given one up."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least:
            raise argparse.ArgumentTypeError(
                f"{text!r} is no whole number from {least}"
            )
        return value

    return parse


def number(low: float = 0.0, high: float = math.inf) -> Callable[[str], float]:
    """Return a reader of numbers above `low` and up to `high`, all finite."""
    bound = f"above {low:g}" + (f" and up to {high:g}" if high < math.inf else "")

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (low < value <= high and math.isfinite(value)):
            raise argparse.ArgumentTypeError(f"{text!r} is no number {bound}")
        return value

    return parse


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keep what MJX and Brax say while they are imported off the terminal."""
    said = io.StringIO()
    with (
        warnings.catch_warnings(),
        contextlib.redirect_stdout(said),
        contextlib.redirect_stderr(said),
    ):
        warnings.simplefilter("ignore")
        yield


def progress() -> Any:
    """Return tqdm's progress bar.

    Raises:
      ImportError: it is missing.
    """
    try:
        import tqdm
    except ImportError as error:
        raise ImportError(f"tqdm is missing; it comes with {EXTRA}") from error
    return tqdm.tqdm
