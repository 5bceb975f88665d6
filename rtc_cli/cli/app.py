"""The `rtc` program: its commands, loaded when they are called, and the one error boundary."""

import importlib
import os
import sys
from collections.abc import Sequence
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.main import get_command

from rtc_cli import __version__
from rtc_cli.errors import RtcError, StateError, UsageError, did_you_mean

EXIT_INTERRUPTED = 130
EXIT_BROKEN_PIPE = 141  # what a shell reports for a program that SIGPIPE ended
_OUT_OF_MEMORY = "Out of memory"  # as XLA says it

COMMANDS = {
    "run": "Do the whole job: train, evaluate, profile, report.",
    "train": "Train experts, then the base and the prefix policy.",
    "eval": "Measure success under delay for each way of hiding it.",
    "profile": "Time one chunk per sampler.",
    "latency": "Analyse measured latencies: which delay, H and s, and what to train on.",
    "ablate": "Compare distributions of delays simulated in training.",
    "report": "Write the report of a run: Markdown and one HTML page.",
    "tasks": "List, describe and render the tasks.",
}


class LazyGroup(TyperGroup):
    """A group whose commands are imported when called, not when their names are listed."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names in the order of the help page."""
        return list(COMMANDS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Import the module of one command."""
        if cmd_name not in COMMANDS:
            return None
        module = importlib.import_module(f"rtc_cli.cli.{cmd_name}")
        command = get_command(module.app)
        command.name = cmd_name
        _unify(command)
        return command

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command; UsageError with the nearest name."""
        name = args[0]
        if name not in COMMANDS and not name.startswith("-") and not ctx.resilient_parsing:
            raise UsageError(
                f'unknown command "{name}".{did_you_mean(name, COMMANDS)}', 'see "rtc --help"'
            )
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write the list of commands without importing them."""
        with formatter.section("Commands"):
            formatter.write_dl(list(COMMANDS.items()))

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        """Read the command line; Ctrl-C becomes an error with its own exit code."""
        try:
            return super().make_context(*args, **kwargs)
        except KeyboardInterrupt:
            raise _interrupted() from None

    def invoke(self, ctx: Any) -> Any:
        """Run the command; Ctrl-C becomes an error with its own exit code."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise _interrupted() from None


def _unify(command: Any) -> None:
    """Give every command the same plain help page; completion belongs to the program."""
    command.rich_markup_mode = None
    own = ("install_completion", "show_completion")
    command.params = [param for param in command.params if param.name not in own]
    for nested in getattr(command, "commands", {}).values():
        _unify(nested)


app = typer.Typer(
    cls=LazyGroup,
    name="rtc",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog="Start with: rtc run quickstart",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"rtc {__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool,
        typer.Option(
            "--version", help="Print the version.", is_eager=True, callback=_print_version
        ),
    ] = False,
) -> None:
    """Real-time execution of action-chunking flow policies, measured.

    How much success is lost at a given latency, for each way of hiding it; what each way costs;
    which delays to simulate in training.
    """


def run(args: Sequence[str]) -> int:
    """Run one command line; errors become one line on stderr. Returns the exit code."""
    try:
        code = get_command(app).main(list(args), prog_name="rtc", standalone_mode=False)
        sys.stdout.flush()
        return code if isinstance(code, int) else 0
    except BrokenPipeError:
        return _close_broken_pipe()
    except RtcError as error:
        return _fail(error)
    except OSError as error:
        from rtc_cli.files import os_error

        return _fail(os_error(error), error)
    except KeyboardInterrupt:
        return _fail(_interrupted())
    except typer.Abort:
        return _fail(RtcError("aborted"))
    except Exception as error:
        if isinstance(error, MemoryError) or _OUT_OF_MEMORY in str(error):
            return _fail(_out_of_memory(error), error)
        if not hasattr(error, "format_message"):
            raise
        return _fail_usage(error)


def _interrupted() -> RtcError:
    return RtcError("interrupted; run again to resume", exit_code=EXIT_INTERRUPTED)


def _out_of_memory(error: Exception) -> RtcError:
    """Say in one line what JAX or NumPy could not allocate."""
    _, found, rest = str(error).partition(_OUT_OF_MEMORY)
    what = f"{found}{rest}".strip().splitlines() or [_OUT_OF_MEMORY]
    return StateError(what[0], "take a smaller network, batch or number of workers, or free some")


def _fail_usage(error: Any) -> int:
    """Report what typer's parser refused; an empty command line gets the help page."""
    context = getattr(error, "ctx", None)
    if type(error).__name__ == "NoArgsIsHelpError" and context is not None:
        print(context.get_help())
        return 0
    command = context.command_path if context is not None else "rtc"
    message = " ".join(error.format_message().replace("Value error, ", "").split())
    given = getattr(error.__cause__, "errors", None)
    value = f", not {given()[0]['input']}" if given else ""
    return _fail(UsageError(message.rstrip(".") + value, f'see "{command} --help"'))


def _fail(error: RtcError, cause: BaseException | None = None) -> int:
    """Print "rtc: error: ..." and the hint; the traceback too where RTC_DEBUG is set."""
    if os.environ.get("RTC_DEBUG"):
        import traceback

        traceback.print_exception(cause or error, file=sys.stderr)
    kind = "" if error.exit_code == EXIT_INTERRUPTED else "error: "
    hint = f" ({error.hint})" if error.hint else ""
    try:
        print(f"rtc: {kind}{_one_line(error.message)}{_one_line(hint)}", file=sys.stderr)
    except BrokenPipeError:
        return _close_broken_pipe()
    return error.exit_code


def _one_line(text: str) -> str:
    return " ".join(text.splitlines())


def _close_broken_pipe() -> int:
    """Be quiet when the reader of our output has gone, also when Python flushes at its end."""
    devnull = os.open(os.devnull, os.O_WRONLY)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except BrokenPipeError:
            os.dup2(devnull, stream.fileno())
    return EXIT_BROKEN_PIPE
