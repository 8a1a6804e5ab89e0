"""What a run shows on the terminal: progress with frame rate and status, and tables at the end."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress
from rich.table import Table

from slam.data import FrameResult
from slam.errors import SlamError
from slam.run.results import rows, verdict_of_run
from slam.runtime.compilation import compile_clock, working_time

if TYPE_CHECKING:
    from slam.compare.tables import Group

_console = Console(emoji=False)  # `mine:Zero:` is a back end
_COLOURS = {"better": "green", "worse": "dark_orange3"}  # of verdicts


def _bar(*columns: ProgressColumn, quiet: bool, **options: Any) -> RichProgress:
    """A progress bar on standard error that fits into 80 columns."""
    shown = (TextColumn("{task.description}", markup=False), BarColumn(bar_width=10), MofNCompleteColumn(), *columns)
    return RichProgress(*shown, TimeRemainingColumn(), console=Console(stderr=True), disable=quiet, **options)


@contextmanager
def progress(total: int | None, title: str, quiet: bool = False) -> Iterator[Callable[[FrameResult], None]]:
    """One line over frames, without an end where `total` is None; it appears with the first one.

    While kernels are compiled the line says so, and how many are done.
    """
    bar = _bar(TextColumn("{task.fields[status]}", markup=False), quiet=quiet, get_time=working_time)
    task, last = bar.add_task(title, total=total, status="", visible=False), ""

    def compiling(done: int, of: int) -> None:
        bar.start()
        bar.update(task, status=f"compiling {done}/{of}, once", visible=True)

    def frame(result: FrameResult) -> None:
        nonlocal last
        bar.start()
        speed = bar.tasks[task].speed
        said = f"{result.status.value} {len(result.report.used)}/{result.map_size}"  # landmarks used, known
        last = f"{speed:.1f} Hz {said}" if speed else said
        bar.update(task, advance=1, status=last, visible=True)

    compile_clock.watch = compiling
    try:
        yield frame
    finally:
        compile_clock.watch = None
        bar.update(task, status=last)  # kernels may have been compiled after it
        if bar.live.is_started:
            bar.stop()


@contextmanager
def counting(total: int | None, title: str, quiet: bool = False) -> Iterator[Callable[[int], None]]:
    """A progress bar that is told how many frames are done."""
    with _bar(quiet=quiet) as bar:
        task = bar.add_task(title, total=total)
        yield lambda done: bar.update(task, completed=done)


def print_conclusions(every: Sequence[Group]) -> None:
    """What may be concluded of each group, in the words of the report."""
    from slam.compare import tables

    for group in every:
        _say(f"\n{group.name}", "bold")
        for text in tables.sentences(group):
            _say(text)
        table = empty_table("", tables.heads(group))
        for metric in group.first_metrics:
            first, *others = tables.row(group, metric)
            words = ((cell["mean"], _COLOURS.get(cell["verdict"], "default"), cell["verdict"]) for cell in others)
            cells = [f"{mean} [{colour}]{verdict}[/]" for mean, colour, verdict in words]
            table.add_row(escape(metric.title), first["mean"], *cells)
        _console.print(table, highlight=False)
        for text in tables.honesty(group):
            _say(text)


def empty_table(title: str, names: Iterable[str]) -> Table:
    """An empty table with a column for each name."""
    table = Table(title=escape(title) or None, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column("")
    for name in names:
        table.add_column(escape(name), justify="right")
    return table


def _say(text: str, style: str | None = None) -> None:
    _console.print(escape(text), style=style, highlight=False)


def print_summary(summaries: list[dict[str, Any]], files: Sequence[Path]) -> None:
    """A table of finished runs, a column each, whether their covariances hold, and what was written."""
    table = empty_table(summaries[0]["sequence"].partition("?")[0], (summary["backend"] for summary in summaries))
    for label, values in rows(summaries):
        table.add_row(escape(label), *values)
    _console.print(table)
    for summary in summaries:
        if words := verdict_of_run(summary):
            _say(f"{summary['backend']}: {words}")
    _say(f"Files: {', '.join(map(str, files))}")


def print_listing(options: bool = False) -> None:
    """Back ends, front ends, formats and built-in sequences, these with their options where they are asked for."""
    from slam import registry, worlds
    from slam.sequences import formats

    if options:
        for text in (*(f"synthetic:{worlds.describe(name)}" for name in worlds.names()), worlds.describe_common()):
            _say(f"\n{text}")
        return
    table = Table.grid(padding=(0, 2))
    for role, title in (("backends", "back ends"), ("frontends", "front ends")):
        table.add_row(f"[bold]{title}[/]")
        for name in registry.names(role):
            try:
                text = cleandoc(registry.resolve(role, name).__doc__ or "").partition("\n\n")[0]
            except SlamError as error:  # one of another package that is broken
                text = str(error)
            table.add_row(escape(name), escape(" ".join(text.split())))
    table.add_row("[bold]built-in sequences[/]")
    for name in worlds.names():
        table.add_row(f"synthetic:{name}", escape(worlds.describe(name).splitlines()[0].partition(": ")[2]))
    table.add_row("[bold]formats[/]", ", ".join(formats()))
    _console.print(table, highlight=False)
    _say("`slam list --options` shows the options of built-in sequences, `slam settings NAME` of back and front ends.")
