"""The ``usdfab`` command: one module per sub-command, loaded when it runs.

Exit codes: 0 done; 1 the check found warnings (--strict); 2 bad input or usage, or the check found errors; 3 no
fabric found in the photo; 130 interrupted.
Results go to stdout, talk goes to stderr.
"""

from __future__ import annotations

import os
import sys

from cyclopts import App, CycloptsError

from usdfab._version import __version__
from usdfab.cli.quick_start import collect_rarely, leave
from usdfab.errors import UsdfabError

USAGE_ERROR, INTERRUPTED = 2, 130

HELP = """From one microscope photo of woven cloth to a USD asset made of fibers, rendered at any distance.

Usage examples:

    usdfab fit photo.png -o fabric.usda --size 3.6mm --report report
    usdfab render fabric.usda -o swatch.png
    usdfab bind cloth.usda fabric.usda -o bound.usda
    usdfab render cloth.usda --fabric fabric.usda -o cloth.exr
    usdfab inspect fabric.usda
"""

COMMANDS = {
    "fit": "Estimate a fabric from one photo of woven cloth.",
    "render": "Render a fabric as a swatch, or a stage whose meshes wear fabrics.",
    "merge": "Join the parts of a picture that render --tile wrote.",
    "inspect": "Look at the fibers of a fabric, in a window or as a picture.",
    "view": "Look at cloth in real time, and change it, in a window or as a picture.",
    "bind": "Put a fabric on the cloth of a stage, and see how it stretches.",
    "expand": "Write the cloth of a stage as instanced fibers for any USD program.",
    "export": "Bake a fabric into maps for any program: USD layer, MaterialX, USDZ, U3M.",
    "new": "Write a new fabric from a preset, a weave or a weavers' draft.",
    "edit": "Change a fabric, mix two, or give one several colourways.",
    "draft": "Write a fabric as a weavers' draft, or draw its drawdown.",
    "info": "Print the fabrics of a file with all parameters, or what this machine has.",
    "check": "Check a USD file against USD's validators and usdfab's rules.",
    "dataset": "Make data sets of random fabrics or surface materials, to train networks on.",
    "train": "Train the network that guesses a fabric from a photo, or the neural material.",
    "evaluate": "Judge usdfab's estimates, and its losses, on photos.",
    "schema": "Print the folder of usdfab's USD schema, for PXR_PLUGINPATH_NAME.",
}
"""One line for each command; its own page comes from the doc string of its function, which is loaded only then."""


def make_app(chosen: str = "") -> App:
    """The command-line application; commands are import strings, resolved when they run. ``chosen`` is about to run."""
    app = App(
        name="usdfab",
        version=__version__,
        help=HELP,
        help_format="markdown",
        result_action="return_value",
        suppress_keyboard_interrupt=False,  # _run says it and sets the exit code
    )
    for name, line in COMMANDS.items():
        if name == chosen:
            app.command(f"usdfab.cli.{name}:run", name=name)
        else:
            app.command(f"usdfab.cli.{name}:run", name=name, help=line)
    return app


def main() -> None:
    """Run the command line and end the process with its exit code."""
    collect_rarely()
    leave(_run(sys.argv[1:]))


def _run(arguments: list[str]) -> int:
    try:
        result = make_app(next(iter(arguments), ""))(arguments, exit_on_error=False, print_error=False)
        return result if isinstance(result, int) else 0
    except UsdfabError as error:
        print(f"usdfab: {' '.join(str(error).split())}", file=sys.stderr)
        return error.exit_code
    except CycloptsError as error:
        print(f"usdfab: {' '.join(str(error).split())}; see usdfab --help", file=sys.stderr)
        return USAGE_ERROR
    except RuntimeError as error:
        # Values of a damaged .usdc are unpacked, and found to be damaged, wherever they are first looked at.
        if not type(error).__module__.startswith("pxr."):
            raise
        from usdfab.usd.stage import usd_reason

        print(f"usdfab: USD cannot read a file ({usd_reason(error)})", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print("usdfab: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our output went away (usdfab info ... | head): not an error of ours.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0


if __name__ == "__main__":
    main()
