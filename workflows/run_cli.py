"""``pilotage plan``, ``run``, ``show`` and ``ck``."""

import contextlib
import signal
import time
from collections import Counter
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

from pipeline.errors import ConfigurationError
from workflows.ck import FOLDER, write_c_kernels
from workflows.execute import ClusterOptions
from workflows.notify import notify
from workflows.opening import open_both, open_remembered, remembered_configuration
from workflows.plan import Plan, ids_of, make_plan
from workflows.report import (
    compare,
    offsets,
    print_comparison,
    print_counts,
    print_image,
    read_truth,
)
from workflows.run import RunListener, execute, exit_code
from workflows.run_log import LogFormat, logged_to, terminal
from workflows.store import RunFolder, document_of, refuse_foreign
from workflows.task import Outcome

_SILENT = RunListener(lambda workers: None, lambda outcome: None)
_LOG_EVERY_S = 5.0
_LOG_WIDTH = 130

ArchiveArg = Annotated[str, typer.Argument(help="Folder or URL with an archive.yaml, or the path of one.")]
RunArg = Annotated[Path, typer.Argument(help="Folder of a run.")]
ConfigOption = Annotated[
    list[Path], typer.Option("--config", help="YAML file on top of the shipped ones (repeatable).")
]
SetOption = Annotated[
    list[str],
    typer.Option("--set", help="One key, a.b=c; archive.KEY=VALUE replaces a key of archive.yaml (repeatable)."),
]
OutputOption = Annotated[
    Path, typer.Option("--output", "-o", help="Folder of the run; an earlier run there is resumed.")
]
VerifyOption = Annotated[bool, typer.Option("--verify", help="Read inputs again instead of trusting size and time.")]


def plan(
    archive: ArchiveArg,
    output: OutputOption,
    config: ConfigOption = [],  # noqa: B006 - typer's way of declaring a repeatable option
    settings: SetOption = [],  # noqa: B006
    verify: VerifyOption = False,
) -> None:
    """Say what `run` would do, and do nothing."""
    refuse_foreign(RunFolder(output))
    work = make_plan(*open_both(archive, config, settings), RunFolder(output), verify)
    typer.echo(f"{len(work.every)} images, {len(work.every) - len(work.todo)} answered, {len(work.todo)} to do")
    for ref in work.todo[:20]:
        typer.echo(f"  {ref.image_id}  {ref.path}{'' if ref.exists else '  (not there)'}")
    if len(work.todo) > 20:
        typer.echo(f"  ... and {len(work.todo) - 20} more")


def run(
    archive: ArchiveArg,
    output: OutputOption,
    workers: Annotated[int, typer.Option(min=1, max=1024, help="Worker processes of a local cluster.")] = 2,
    serial: Annotated[bool, typer.Option("--serial", help="No cluster: one image after the other.")] = False,
    scheduler: Annotated[str | None, typer.Option(help="Address of an existing Dask scheduler.")] = None,
    memory_limit: Annotated[str, typer.Option(help="Per local worker; one beyond it is restarted.")] = "4GiB",
    config: ConfigOption = [],  # noqa: B006
    settings: SetOption = [],  # noqa: B006
    verify: VerifyOption = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Say each technique's rotation.")] = False,
    log_format: Annotated[LogFormat, typer.Option(help="text, or all of RUN/log.jsonl as it is written.")] = (
        LogFormat.TEXT
    ),
    pictures: Annotated[str, typer.Option(help="RUN/pictures of: all, failed, sample:N, none.")] = "none",
    tell: Annotated[str | None, typer.Option("--notify", help="Command that gets run.json as its input.")] = None,
) -> None:
    """Navigate an archive; run again after a kill or a change, and only what is missing is done.

    Exit code: 0 all images navigated, 1 some failed or conflicted, 2 some in error, 3 could not start.
    """
    if serial and scheduler:
        raise ConfigurationError("--serial and --scheduler exclude each other")
    folder = RunFolder(output)
    # The death of a worker closes a socket under our hands, which is no reason to end.
    signal.signal(signal.SIGPIPE, signal.SIG_IGN)
    refuse_foreign(folder)
    if pictures != "none":
        from workflows.pictures import chosen, draw_all

        # What is wrong is said before the run.
        chosen(folder, [], pictures)
    opened, configuration = open_both(archive, config, settings)
    options = ClusterOptions(0 if serial else workers, scheduler, memory_limit)
    as_json = log_format is LogFormat.JSON
    console = Console(stderr=True, quiet=as_json)
    with terminal(log_format, verbose):
        work = make_plan(opened, configuration, folder, verify)
        with contextlib.ExitStack() as shown:
            listener = _SILENT if as_json else shown.enter_context(_follow(console, work))
            statuses = execute(work, options, listener)
        with logged_to(output):
            if pictures != "none":
                draw_all(opened, folder, chosen(folder, ids_of(work.every), pictures))
            if tell is not None:
                notify(tell, folder)
    counts = ", ".join(f"{count} {status}" for status, count in sorted(statuses.items()))
    console.print(
        f"{len(work.every)} images: {counts}. Tables and images/*.json in {output}",
        highlight=False, soft_wrap=True, markup=False,
    )  # fmt: skip
    raise typer.Exit(exit_code(statuses))


@contextlib.contextmanager
def _follow(console: Console, work: Plan):  # type: ignore[no-untyped-def]
    """Progress bar on a terminal, plain lines in a log."""
    counts: Counter[str] = Counter()
    total = len(work.todo)
    times: list[float] = []

    def count(outcome: Outcome) -> None:
        counts[outcome.status] += 1
        times[1:] = [time.monotonic()]

    def line() -> str:
        return " ".join(f"{status}:{count}" for status, count in sorted(counts.items()))

    def speed() -> str:
        # Workers load and compile before their first answer, which tells nothing of the others.
        done, taken = sum(counts.values()), times[-1] - times[0]
        if done < 2 or taken <= 0:
            return ""
        rate = (done - 1) / taken
        return f"  {rate:.2g} images/s, {(total - done) / rate:.0f} s left"

    answered = len(work.every) - total

    def start() -> None:
        console.print(f"{len(work.every)} images, {answered} answered before, {total} to do", highlight=False)

    if console.is_terminal:
        columns = (
            TextColumn("navigating"),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("{task.description}"),
        )
        with Progress(*columns, console=console) as progress:
            task = progress.add_task("", total=total)

            def on_done(outcome: Outcome) -> None:
                count(outcome)
                progress.update(task, advance=1, description=line() + speed())

            yield RunListener(lambda text: progress.console.print(text, highlight=False), on_done, start)
        return
    last = time.monotonic()

    def log_done(outcome: Outcome) -> None:
        nonlocal last
        count(outcome)
        done = sum(counts.values())
        if time.monotonic() - last > _LOG_EVERY_S or done == total:
            last = time.monotonic()
            console.print(f"{done}/{total}  {line()}{speed()}", highlight=False, soft_wrap=True)

    yield RunListener(lambda text: console.print(text, highlight=False, soft_wrap=True), log_done, start)


def show(
    run_folder: RunArg,
    image: Annotated[str | None, typer.Argument(help="Image id.")] = None,
    truth: Annotated[Path | None, typer.Option(help="truth.json of a sample archive to compare with.")] = None,
    limit: Annotated[int, typer.Option(min=1, help="Most rows shown.")] = 40,
) -> None:
    """Show outcome counts, one image, or a run against planted truth."""
    folder, console = RunFolder(run_folder), _console()
    if image is not None:
        print_image(console, document_of(folder, image))
        return
    table = offsets(folder)
    print_counts(console, table)
    if truth is not None:
        print_comparison(console, *compare(table, read_truth(truth)), limit)


def _console() -> Console:
    """The terminal's width where there is one; in a pipe or a log, wide enough for every table."""
    console = Console()
    return console if console.is_terminal else Console(width=_LOG_WIDTH)


def ck(
    run_folder: RunArg,
    archive: Annotated[
        str | None, typer.Argument(help="Folder or URL of the archive; by default where the run found it.")
    ] = None,
    output: Annotated[Path | None, typer.Option("--output", "-o", help="Folder to write; RUN/ck by default.")] = None,
    config: ConfigOption = [],  # noqa: B006
    settings: SetOption = [],  # noqa: B006
) -> None:
    """Write corrected pointing as SPICE C-kernels, and a meta-kernel that loads them after the archive's own."""
    folder = RunFolder(run_folder)
    if archive is not None:
        opened, configuration = open_both(archive, config, settings)
    elif config or settings:
        raise ConfigurationError("ck: --config and --set need ARCHIVE beside; without it all is as the run had it")
    else:
        opened, configuration = open_remembered(folder, "ARCHIVE"), remembered_configuration(folder, "ARCHIVE")
    for path in write_c_kernels(folder, opened, configuration, output or run_folder / FOLDER):
        typer.echo(f"{path}")
