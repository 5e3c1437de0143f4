"""The entry point: the table of commands, and the one place where errors become messages and exit statuses."""

from __future__ import annotations

import gc
import io
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from lidarpose import __version__
from lidarpose.errors import InputError, LidarposeError

if TYPE_CHECKING:
    from cyclopts import App, CycloptsError

EXIT_DONE = 0
EXIT_UNDETERMINED = 1
EXIT_WRONG_INPUT = 2
EXIT_INTERRUPTED = 130

# New objects between two searches for garbage. Modules and models are some hundred thousand objects that stay: Python
# would go through them again and again, for a tenth of the time of a short command.
_GARBAGE_THRESHOLD = 100_000

# Commands are named as text, so that `lidarpose --help` imports none of them.
_COMMANDS: dict[str, tuple[str, str]] = {
    "demo": ("lidarpose.cli.demo:demo", "Simulate, calibrate, scan and measure, in about a minute."),
    "inspect": ("lidarpose.cli.inspect:inspect", "What a session holds, lacks, and will determine badly."),
    "calibrate": ("lidarpose.cli.calibrate:calibrate", "Find the LiDAR's pose from a session."),
    "scan": ("lidarpose.cli.scan:scan", "Turn a sweep recording into a 3D cloud."),
    "import": ("lidarpose.cli.import_bag:import_bag", "Make a recording or session of a ROS bag or of packets."),
    "export": (
        "lidarpose.cli.export:export",
        "Write a calibration for ROS 2, URDF, Kalibr, OpenCV, CloudCompare, or as CSV.",
    ),
    "view": ("lidarpose.cli.view:view", "Look at clouds and rigs in 3D, or write a recording to send."),
    "pose": ("lidarpose.cli.pose:pose", "The LiDAR's pose at a turntable angle, with its standard deviations."),
}
_GROUPS: dict[str, tuple[str, dict[str, tuple[str, str]]]] = {
    "measure": (
        "Sizes from a sweep recording or a cloud.",
        {
            "disk": ("lidarpose.cli.measure_disk:measure_disk", "A disk's diameter, or round holes in a plane."),
            "box": ("lidarpose.cli.measure_box:measure_box", "A box's three edge lengths."),
            "planes": ("lidarpose.cli.measure_planes:measure_planes", "Planes, and their angles to each other."),
        },
    ),
    "simulate": (
        "Make up a session or recording with its truth beside it.",
        {
            "turntable": (
                "lidarpose.cli.simulate_turntable:simulate_turntable",
                "A LiDAR on a turntable before a camera and a V board.",
            ),
            "corners": (
                "lidarpose.cli.simulate_corners:simulate_corners",
                "A target of three faces moved from place to place before a 3D LiDAR.",
            ),
            "scene": (
                "lidarpose.cli.simulate_scene:simulate_scene",
                "A sweep recording of boxes, disks and planes of your own.",
            ),
            "disk": ("lidarpose.cli.simulate_disk:simulate_disk", "A sweep recording of a disk before a background."),
        },
    ),
}


def build_app() -> App:
    """The whole command line as a cyclopts application."""
    from cyclopts import App

    app = App(
        name="lidarpose",
        version=__version__,
        # Reading Markdown costs a quarter of the start; the commands' own texts, with lines to be filled, need it.
        help_format="plaintext",
        # `run` has its own message for an interrupted command.
        suppress_keyboard_interrupt=False,
        help="Find where a LiDAR is, how sure that is, and turn what it sees into metric 3D.",
        help_epilogue=(
            "Exit status: 0 done; 1 the data do not determine what was asked; 2 wrong usage or unreadable input."
        ),
    )
    for name, (target, text) in _COMMANDS.items():
        app.command(target, name=name, help=text, help_format="markdown")
    for name, (text, members) in _GROUPS.items():
        group = App(name=name, help=text)
        for member, (target, member_text) in members.items():
            group.command(target, name=member, help=member_text, help_format="markdown")
        app.command(group)
    return app


def run(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status; messages go to standard error."""
    try:
        from cyclopts import CycloptsError

        try:
            call(arguments)
        finally:
            sys.stdout.flush()
    except KeyboardInterrupt:
        return _complain("interrupted; nothing half-written is left behind", status=EXIT_INTERRUPTED)
    except InputError as error:
        return _complain(str(error), status=EXIT_WRONG_INPUT)
    except LidarposeError as error:
        return _complain(str(error), status=EXIT_UNDETERMINED)
    except OSError as error:
        return _unwritten(error)
    except SystemExit:
        # So the help ends where its reader went away.
        return EXIT_DONE
    except CycloptsError as error:
        hint = f"See: {' '.join(('lidarpose', *(error.command_chain or ())))} --help"
        return _complain(_usage(error), hint=hint, status=EXIT_WRONG_INPUT)
    return EXIT_DONE


def call(arguments: Sequence[str] | None = None) -> None:
    """Run one command and let its errors through."""
    build_app()(arguments, exit_on_error=False, print_error=False, result_action="return_value")


def _unwritten(error: OSError) -> int:
    """Standard output, or a file that no reader or writer looked after, could not be read or written."""
    from lidarpose.cli.console import hang_up

    if error.filename is None:
        hang_up()
    if isinstance(error, BrokenPipeError):
        # The reader of our output went away (`lidarpose ... | head`); there is nobody left to tell.
        return EXIT_DONE
    where = error.filename or "standard output"
    return _complain(f"{where}: {error.strerror or error}", status=EXIT_WRONG_INPUT)


def _usage(error: CycloptsError) -> str:
    """What is wrong with the command line."""
    from cyclopts import RepeatArgumentError

    if isinstance(error, RepeatArgumentError) and error.app is not None:
        option = error.token.keyword
        arguments = error.app.assemble_argument_collection()
        names = next((a.names for a in arguments if option in a.names), (option,))
        tokens = dict.fromkeys(token.split("=")[0] for token in error.root_input_tokens or ())
        given = [token for token in tokens if token in names]
        if len(given) > 1:
            return f"{' and '.join(given)} are given together: give one of them"
        return f"{option} is given more than once"
    return str(error).strip() or "wrong usage"


def _complain(message: str, *, status: int, hint: str | None = None) -> int:
    print(f"lidarpose: {message}", file=sys.stderr)
    if hint:
        print(hint, file=sys.stderr)
    return status


def _prepare_streams() -> None:
    """Print as an escape what the output's encoding has no sign for, and to nowhere what goes to a closed stream."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, io.StringIO())
        elif isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def main() -> None:
    """Console script."""
    gc.set_threshold(_GARBAGE_THRESHOLD)
    _prepare_streams()
    status = run()
    # The interpreter searches all objects for garbage once more as it ends: a fifth of the start, for nothing. To the
    # packets' decoder what is not searched looks like a leak, and it prints pages about that.
    if "velodyne_decoder" not in sys.modules:
        gc.freeze()
    sys.exit(status)
