"""What a run shows on the terminal: progress with frame rate and status, and tables at the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
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


class Progress:
    """A progress bar over frames; a context manager.

    Args:
        total: number of frames; None where there is no end.
        title: shown before the bar.
        quiet: show nothing.

    Attributes:
        last: the latest result; None before the first.
    """

    def __init__(self, total: int | None, title: str, quiet: bool = False) -> None:
        self._bar = RichProgress(
            TextColumn("{task.description}"),
            BarColumn(bar_width=10),  # all fits into 80 columns
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]} {task.fields[status]}"),
            TimeRemainingColumn(),
            console=Console(stderr=True),
            disable=quiet,
            get_time=working_time,
        )
        self.last: FrameResult | None = None
        self._task = self._bar.add_task(title, total=total, rate="", status="")

    def __enter__(self) -> Progress:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.last is not None:  # else it was never shown
            self._bar.stop()

    def frame(self, result: FrameResult) -> None:
        """Show one more frame; the bar appears with the first."""
        self.last = result
        self._bar.start()
        task = self._bar.tasks[0]
        rate = f"{task.speed:.1f} Hz" if task.speed else ""
        status = f"{result.status.value} {len(result.report.used)}/{result.map_size}"  # landmarks used, known
        self._bar.update(self._task, advance=1, rate=rate, status=status)


@contextmanager
def counting(total: int | None, title: str, quiet: bool = False) -> Iterator[Callable[[int], None]]:
    """A progress bar that is told how many frames are done."""
    bar = RichProgress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=quiet,
    )
    task = bar.add_task(title, total=total)
    with bar:
        yield lambda done: bar.update(task, completed=done)


class SweepProgress:
    """A progress bar over the frames of all runs of a comparison, with the time left; a context manager.

    Args:
        frames: of each run.
        quiet: show nothing.
    """

    def __init__(self, frames: Sequence[int], quiet: bool = False) -> None:
        self._bar = RichProgress(
            TextColumn("runs {task.fields[runs]}, frames"),
            BarColumn(bar_width=10),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]}"),
            TextColumn("{task.fields[left]}"),
            console=Console(stderr=True),
            disable=quiet,
        )
        self._runs, self._ended, self._ended_frames, self._counted, self._before = len(frames), 0, 0, 0, 0
        self._round = 0  # frames that were counted in scheduler calls that are over
        self._began = time.monotonic()
        self._task = self._bar.add_task("", total=sum(frames), runs=f"0/{self._runs}", rate="", left="")

    def __enter__(self) -> SweepProgress:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def kept(self, frames: int) -> None:
        """A run of so many frames was done before."""
        self._before += frames
        self.ended(frames)

    def ended(self, frames: int) -> None:
        """A run of so many frames is over."""
        self._ended += 1
        self._ended_frames += frames
        self._show()

    def frames(self, counted: int) -> None:
        """So many frames were done in this call of a scheduler; the next one begins at zero."""
        if counted < self._counted:
            self._round += self._counted
        self._counted = counted
        self._show()

    def _show(self) -> None:
        """Frames of runs that are over, or where that is more, those counted while they run."""
        done = max(self._ended_frames, self._before + self._round + self._counted)
        task = self._bar.tasks[0]
        own = done - self._before  # what was kept took no time now
        total = task.total or 0
        rate = left = ""
        if own > 0:
            speed = own / (time.monotonic() - self._began)
            rate, left = f"{speed:.1f} Hz", str(timedelta(seconds=round(max(total - done, 0) / speed)))
        runs = f"{self._ended}/{self._runs}"
        self._bar.update(self._task, completed=min(done, total), runs=runs, rate=rate, left=left)


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


def _summary_rows(summaries: list[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    """Label and one text per run."""
    rows: list[tuple[str, list[str]]] = [
        ("frames", [str(s["frames"]) for s in summaries]),
        ("status", [", ".join(f"{n} {k}" for k, n in s["status"].items()) for s in summaries]),
        ("landmarks", [str(s.get("landmarks", 0)) for s in summaries]),
        ("path length [m]", [f"{s.get('path_length_m', 0.0):.2f}" for s in summaries]),
        ("speed, median [m/s]", [_figure(s.get("speed_m_per_s")) for s in summaries]),
        _in_its_unit("sigma of the last position [m]", [s.get("final_sigma_m") for s in summaries]),
    ]
    if any("loops" in s for s in summaries):
        loops = [s.get("loops", {}) for s in summaries]
        rows.append(("loops closed, refused", [f"{n.get('closed', '–')}, {n.get('refused', '–')}" for n in loops]))
        rows.append(("moving bodies found", [_figure(s.get("bodies")) for s in summaries]))
    rows += _body_rows([s.get("objects", {}).get("bodies", {}) for s in summaries])
    for when, wanted in (("online", None), ("final", ("ATE RMSE [m]", "GPS distance RMSE [m]"))):
        keys = {key: None for s in summaries for key in s.get("accuracy", {}).get(when, {})}
        for key in keys:
            if key == "poses with truth" or (wanted and key not in wanted):
                continue
            rows.append(_in_its_unit(f"{when} {key}", [s["accuracy"][when].get(key) for s in summaries]))
    if any(s.get("accuracy", {}).get("poses left out") for s in summaries):
        rows.append(("poses not measured, left out", [str(s["accuracy"]["poses left out"]) for s in summaries]))
    for key in ("NEES over 10 m", "NEES over 100 m", "scale error [%]", "scale sigma [%]"):
        if any(key in s.get("consistency", {}) for s in summaries):
            name = f"{key} (6 is right)" if key.startswith("NEES") else key
            rows.append((name, [_figure(s.get("consistency", {}).get(key)) for s in summaries]))
    if any("live" in s for s in summaries):
        live = [s.get("live", {}) for s in summaries]
        rows.append(("frames dropped", [_figure(one.get("frames dropped")) for one in live]))
        behind = [one.get("milliseconds behind", {}) for one in live]
        rows.append(
            ("behind, median and most [ms]", [f"{_figure(b.get('median'))}, {_figure(b.get('max'))}" for b in behind])
        )
    medians = [s.get("milliseconds", {}).get("median_total") for s in summaries]
    rates = [s.get("frames_per_second") for s in summaries]
    ahead = any(rate and median and rate * median > _AHEAD * 1e3 for rate, median in zip(rates, medians))
    rows.append(("stages of a frame together, median [ms]", [_figure(median) for median in medians]))
    name = "frames per second (frames overlap)" if ahead else "frames per second"
    rows.append((name, [_figure(rate) for rate in rates]))
    if any(s.get("compile_seconds", 0.0) > _COMPILED for s in summaries):
        name = "kernels compiled, once, not in the times above [s]"
        rows.append((name, [_figure(s.get("compile_seconds")) for s in summaries]))
    return rows


def _body_rows(bodies: Sequence[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    """How well bodies whose truth is known were found, by their number."""
    rows = []
    for body in dict.fromkeys(body for one in bodies for body in one):
        own = [one.get(body, {}) for one in bodies]
        seen = [f"{_figure(one.get('coverage') and 100 * one['coverage'])} %" for one in own]
        rows.append((f"body {body}: measured, of the frames it moves in", seen))
        for unit in ("[m]", "[deg]"):
            what = f"{'translation' if unit == '[m]' else 'rotation'} median"
            values = [one.get("ME", {}).get(f"{what} {unit}") for one in own]
            rows.append(_in_its_unit(f"body {body}: error of its motion a frame {unit}", values))
    return rows


def _in_its_unit(label: str, values: Sequence[Any]) -> tuple[str, list[str]]:
    """A row whose label names metres: in millimetres where all values are below one metre."""
    if "[m" in label and all(value is None or abs(value) < 1 for value in values):
        label, values = label.replace("[m", "[mm"), [None if value is None else 1e3 * value for value in values]
    return label, [_figure(value) for value in values]


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
