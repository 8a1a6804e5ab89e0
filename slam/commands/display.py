"""What a run shows on the terminal: progress with frame rate and status, and tables at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress
from rich.table import Table

from slam.data import FrameResult
from slam.evaluation.consistency import verdict
from slam.runtime.compile_clock import working_time

if TYPE_CHECKING:
    from slam.compare.report import Conclusions

_console = Console()
_AHEAD = 1.05  # times the rate of one frame after the other, above which frames overlapped
_COMPILED = 0.05  # compile times below this [s] are not worth a row


def _bar(*columns: ProgressColumn, quiet: bool, **options: Any) -> RichProgress:
    """A progress bar on standard error that fits into 80 columns."""
    shown = (BarColumn(bar_width=10), MofNCompleteColumn(), *columns, TimeRemainingColumn())
    first = TextColumn("{task.description}")
    return RichProgress(first, *shown, console=Console(stderr=True), disable=quiet, **options)


class Progress:
    """A progress bar over frames; a context manager.

    Args:
        total: number of frames; None where there is no end.
        title: shown before the bar.
        quiet: show nothing.
    """

    def __init__(self, total: int | None, title: str, quiet: bool = False) -> None:
        status = TextColumn("{task.fields[rate]} {task.fields[status]}")
        self._bar = _bar(status, quiet=quiet, get_time=working_time)
        self._shown = False
        self._task = self._bar.add_task(title, total=total, rate="", status="")

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._shown:
            self._bar.stop()

    def frame(self, result: FrameResult) -> None:
        """Show one more frame; the bar appears with the first."""
        self._shown = True
        self._bar.start()
        task = self._bar.tasks[0]
        rate = f"{task.speed:.1f} Hz" if task.speed else ""
        status = f"{result.status.value} {len(result.report.used)}/{result.map_size}"  # landmarks used, known
        self._bar.update(self._task, advance=1, rate=rate, status=status)


@contextmanager
def counting(total: int | None, title: str, quiet: bool = False) -> Iterator[Callable[[int], None]]:
    """A progress bar that is told how many frames are done."""
    bar = _bar(quiet=quiet)
    task = bar.add_task(title, total=total)
    with bar:
        yield lambda done: bar.update(task, completed=done)


#: Colours of badges, by direction.
_COLOURS = {"better": "green", "worse": "dark_orange3", "": "default"}


def print_conclusions(every: Sequence[Conclusions], caution: str, reference: str) -> None:
    """What may be concluded, in the words of the report: a badge, and what it is about.

    Args:
        every: of each group.
        caution: what so few trials can show at best; empty where they are enough.
        reference: the back end that the others are compared with.
    """
    from slam.compare.wording import STRENGTH, WORDS

    used = {line.verdict for found in every for line in found.headlines}
    for found in every:
        _say(found.name, "bold")
        for text in (*found.verdict, found.failed):
            if text:
                _say(text)
        table = Table.grid(padding=(0, 2))
        for line in found.headlines:
            style = f"bold {_COLOURS[line.direction]}" if WORDS[line.verdict] == "certain" else _COLOURS[line.direction]
            table.add_row(f"  [{style}]{escape(line.badge)}[/]", escape(line.text))
        _console.print(table, highlight=False)
        for text in found.honesty:
            _say(f"  {text}")
    meanings = [meaning for verdict, meaning in STRENGTH.items() if verdict in used]
    if meanings:
        _say(f"Better or worse than {reference}: {'; '.join(meanings)}.")
    if caution:
        _say(caution)


def _say(text: str, style: str | None = None) -> None:
    _console.print(escape(text), style=style, highlight=False)


def print_summary(summaries: list[dict[str, Any]], out: Path) -> None:
    """A table of finished runs, a column each."""
    table = Table(title=summaries[0]["sequence"])
    table.add_column("")
    for summary in summaries:
        table.add_column(summary["backend"], justify="right")
    for label, values in _summary_rows(summaries):
        table.add_row(escape(label), *values)
    _console.print(table)
    for summary in summaries:
        words = verdict(summary.get("consistency", {}))
        if words:
            _console.print(f"{summary['backend']}: {words}")
    _console.print(f"Files: {out}")


#: Rows of the table: label, and where a summary has the figure. Rows that no run has are left out.
_ROWS = (
    ("loops closed", "loops.closed"), ("loops refused", "loops.refused"), ("moving bodies found", "bodies"),
    ("online", "accuracy.online.*"), ("final ATE RMSE [m]", "accuracy.final.ATE RMSE [m]"),
    ("final GPS distance RMSE [m]", "accuracy.final.GPS distance RMSE [m]"),
    ("NEES over 10 m (6 is right)", "consistency.NEES over 10 m"),
    ("NEES over 100 m (6 is right)", "consistency.NEES over 100 m"),
    ("scale error [%]", "consistency.scale error [%]"), ("scale sigma [%]", "consistency.scale sigma [%]"),
    ("frames dropped", "live.frames dropped"), ("behind, median [ms]", "live.milliseconds behind.median"),
    ("behind, most [ms]", "live.milliseconds behind.max"),
)  # fmt: skip


def _at(tree: Any, place: str) -> Any:
    """What a summary has at a place; None where it has nothing."""
    for key in place.split("."):
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def _summary_rows(summaries: list[dict[str, Any]]) -> Iterator[tuple[str, list[str]]]:
    """Label and one text per run."""
    yield "frames", [str(s["frames"]) for s in summaries]
    yield "status", [", ".join(f"{n} {k}" for k, n in s["status"].items()) for s in summaries]
    yield "landmarks", [str(s.get("landmarks", 0)) for s in summaries]
    yield "path length [m]", [f"{s.get('path_length_m', 0.0):.2f}" for s in summaries]
    yield "speed, median [m/s]", [_figure(s.get("speed_m_per_s")) for s in summaries]
    yield _in_its_unit("sigma of the last position [m]", [s.get("final_sigma_m") for s in summaries])
    yield from _body_rows([s.get("objects", {}).get("bodies", {}) for s in summaries])
    for label, place in _ROWS:
        names = {place: label}
        if place.endswith("*"):
            keys = dict.fromkeys(
                key for s in summaries for key in _at(s, place[:-2]) or () if key != "poses with truth"
            )
            names = {f"{place[:-1]}{key}": f"{label} {key}" for key in keys}
        for where, name in names.items():
            values = [_at(s, where) for s in summaries]
            if any(value is not None for value in values):
                yield _in_its_unit(name, values)
    if any(_at(s, "accuracy.poses left out") for s in summaries):
        yield "poses not measured, left out", [str(_at(s, "accuracy.poses left out")) for s in summaries]
    medians, rates = ([_at(s, k) for s in summaries] for k in ("milliseconds.median_total", "frames_per_second"))
    ahead = any(rate and median and rate * median > _AHEAD * 1e3 for rate, median in zip(rates, medians))
    yield "stages of a frame together, median [ms]", list(map(_figure, medians))
    yield f"frames per second{' (frames overlap)' if ahead else ''}", list(map(_figure, rates))
    if any(s.get("compile_seconds", 0.0) > _COMPILED for s in summaries):
        label = "kernels compiled, once, not in the times above [s]"
        yield label, [_figure(s.get("compile_seconds")) for s in summaries]


def _body_rows(bodies: Sequence[dict[str, Any]]) -> Iterator[tuple[str, list[str]]]:
    """How well bodies whose truth is known were found, by their number."""
    for body in dict.fromkeys(body for one in bodies for body in one):
        own = [one.get(body, {}) for one in bodies]
        seen = [f"{_figure(one.get('coverage') and 100 * one['coverage'])} %" for one in own]
        yield f"body {body}: measured, of the frames it moves in", seen
        for what, unit in (("translation", "[m]"), ("rotation", "[deg]")):
            values = [one.get("ME", {}).get(f"{what} median {unit}") for one in own]
            yield _in_its_unit(f"body {body}: error of its motion a frame {unit}", values)


def _in_its_unit(label: str, values: Sequence[Any]) -> tuple[str, list[str]]:
    """A row whose label names metres: in millimetres where all values are below one metre."""
    if "[m" in label and "[ms" not in label and all(value is None or abs(value) < 1 for value in values):
        label, values = label.replace("[m", "[mm"), [None if value is None else 1e3 * value for value in values]
    return label, list(map(_figure, values))


def _figure(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, (int, float)) else "–"


def print_listing(options: bool = False) -> None:
    """Back ends, front ends, formats and built-in sequences, these with their options where they are asked for."""
    from slam import registry, worlds
    from slam.sequences import formats

    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_row("back ends", ", ".join(registry.names("backends")))
    table.add_row("front ends", ", ".join(registry.names("frontends")))
    table.add_row("formats", ", ".join(formats()))
    _console.print(table)
    if not options:
        table = Table.grid(padding=(0, 2))
        for name in worlds.names():
            table.add_row(f"synthetic:{name}", escape(worlds.describe(name).splitlines()[0].partition(": ")[2]))
        _console.print("built-in sequences")
        _console.print(table)
        _console.print("`slam list --options` shows the options of each", highlight=False)
        return
    for name in worlds.names():
        _say(f"\nsynthetic:{worlds.describe(name)}")
    _say(f"\n{worlds.describe_common()}")
