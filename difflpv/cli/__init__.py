"""The ``difflpv`` program: one subcommand per file, named as the Python function that does the work.

Exit codes: 0 done, 1 the work failed, 2 bad input (one line on stderr), 130 interrupted. Results go to stdout, warnings,
progress and errors to stderr. Nothing here imports torch or Warp before a command needs them.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import NoReturn

import difflpv
from difflpv.cli.failures import INTERRUPTED, describe_failure
from difflpv.cli.options import UsageError

__all__ = ["COMMANDS", "main"]

COMMANDS = (
    "targets", "plan", "simulate", "fit", "evaluate", "render", "view", "info", "demo", "train_stencil", "stress", "bench",
    "probes",
)  # fmt: skip
_CLOSED_PIPE = 141  # what a shell reports for a program that SIGPIPE ended


class _Parser(argparse.ArgumentParser):
    """Errors in one line, without the usage text in front of them."""

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message} (see '{self.prog} --help')")


def _build() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="difflpv",
        description="Differentiable light propagation volumes: path-traced targets, LPV and HOLPV solves, fits to them.",
        epilog="example:\n"
        "  difflpv targets cornell --lights bundled --receivers 2000 --workers 2 --out out/targets\n"
        "  difflpv fit cornell --targets out/targets --learn propagation,sampling_bias --out out/fit\n"
        "  difflpv evaluate cornell --fitted out/fit --targets out/targets\n\n"
        "'difflpv COMMAND --help' explains a command.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"difflpv {difflpv.__version__}")
    subparsers = parser.add_subparsers(metavar="COMMAND", required=True)
    for name in COMMANDS:
        import_module(f"difflpv.cli.{name}").add_parser(subparsers)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program with the arguments ``argv`` (the process's own by default); returns the exit code."""
    try:
        try:
            args = _build().parse_args(argv)
            code = int(args.run(args))
        finally:
            sys.stdout.flush()  # here, so that a closed pipe is noticed where it can be handled
    except BrokenPipeError:
        # Whoever read the output has enough; Python would complain once more when it flushes stdout at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return _CLOSED_PIPE
    except KeyboardInterrupt:
        print("difflpv: interrupted", file=sys.stderr)
        return INTERRUPTED
    except SystemExit as end:  # --help and --version
        return int(end.code or 0)
    except Exception as error:
        failure = describe_failure(error)
        if failure is None:
            raise
        print(f"difflpv: error: {failure.line}", file=sys.stderr)
        return failure.code
    return code
