"""The program as a whole: help, exit codes, failures in one line."""

import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest
from cli_room import make_targets, write_room

from difflpv.cli import COMMANDS, main
from difflpv.cli.failures import describe_failure

PROGRAM = [sys.executable, "-m", "difflpv.cli"]


def test_help_names_every_command(capsys):
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(re.search(rf"^ +{name.replace('_', '-')}\b", text, re.M) for name in COMMANDS) and "example:" in text


@pytest.mark.parametrize("name", COMMANDS)
def test_each_command_explains_itself_with_an_example(name, capsys):
    assert main([name.replace("_", "-"), "--help"]) == 0
    text = capsys.readouterr().out
    example = text.partition("example:")[2]
    assert f"difflpv {name.replace('_', '-')} " in example
    for option in re.findall(r"--[a-z-]+", example):
        assert option in text.partition("example:")[0], f"the example uses {option}, which the command has not"


def test_help_and_info_load_neither_torch_nor_warp():
    program = (
        "import sys; from difflpv.cli import main; code = main(sys.argv[1:]); "
        "sys.exit(code or [m for m in ('torch', 'warp', 'kornia', 'matplotlib') if m in sys.modules] or 0)"
    )
    result = subprocess.run([sys.executable, "-c", program, "--help"], capture_output=True, text=True, timeout=60)
    assert (result.returncode, result.stderr) == (0, "")


def test_version(capsys):
    assert main(["--version"]) == 0
    assert re.fullmatch(r"difflpv \d+\.\d+\.\d+\n", capsys.readouterr().out)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required: COMMAND (see 'difflpv --help')"),
        (["bake"], "argument COMMAND: invalid choice: 'bake'"),
        (["info"], "the following arguments are required: SCENE (see 'difflpv info --help')"),
        (["info", "cornell", "--gird", "3"], "unrecognized arguments: --gird 3"),
        (["info", "nosuch"], "scene 'nosuch': no such bundled scene, there are atrium, bunny, cornell"),
        (["info", "room.blend"], "room.blend: unknown scene format '.blend', expected .glb, .gltf, .obj, .ply"),
    ],
)
def test_bad_usage_is_one_line_and_code_2(arguments, message, capsys):
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("difflpv: error: " + message) and err.count("\n") == 1


def test_interrupt_is_code_130(monkeypatch, capsys):
    def interrupted(args):
        raise KeyboardInterrupt

    monkeypatch.setattr("difflpv.cli.info.run", interrupted)
    assert main(["info", "cornell"]) == 130
    assert capsys.readouterr().err == "difflpv: interrupted\n"


def test_a_bug_keeps_its_traceback(monkeypatch):
    def broken(args):
        raise ValueError("operands could not be broadcast")

    monkeypatch.setattr("difflpv.cli.info.run", broken)
    with pytest.raises(ValueError, match="operands could not be broadcast"):
        main(["info", "cornell"])


def test_expected_failures_and_their_codes():
    from data_gen.blocks import WorkerError
    from data_gen.load import TargetsError
    from difflpv.fitted import FittedError
    from difflpv.io.exr import ImageError
    from difflpv.io.tables import TableError
    from difflpv.optim.checkpoint import CheckpointError
    from difflpv.scene import SceneError

    for kind in (SceneError, TargetsError, TableError, ImageError, FittedError, CheckpointError):
        assert (describe_failure(kind("a\nb")).line, describe_failure(kind("a")).code) == ("a b", 2)
    assert describe_failure(WorkerError("died")).code == 1
    assert describe_failure(FloatingPointError("irradiance is not finite")).code == 1
    assert describe_failure(PermissionError(13, "Permission denied", "/x")).line == "/x: Permission denied"
    full = "can't allocate memory: you tried to allocate 8 bytes"
    for error in (RuntimeError(f"[enforce fail at x.cpp:127] err == 0. DefaultCPUAllocator: {full}"), MemoryError(full)):
        assert (describe_failure(error).line, describe_failure(error).code) == (f"not enough memory: {full}", 1)
    for bug in (ValueError("x"), TypeError("x"), OSError("x"), RuntimeError("x")):
        assert describe_failure(bug) is None


@pytest.mark.skipif(os.name != "posix", reason="pipes close with SIGPIPE on POSIX only")
def test_a_closed_pipe_is_quiet():
    process = subprocess.Popen([*PROGRAM, "info", "cornell", "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (141, b"")


def hear_ctrl_c():
    """A shell starts its background jobs deaf to SIGINT, and children inherit that: tests run there too."""
    signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="needs SIGINT")
def test_ctrl_c_in_a_fit_saves_and_goes_on(tmp_path):
    """A real signal in a real process; the checkpoint appears once the solver is at work."""
    scene = write_room(tmp_path)
    targets, out = make_targets(tmp_path, scene), tmp_path / "fit"
    command = [*PROGRAM, "fit", scene, "--targets", targets, "--learn", "propagation,sampling_bias", "--solver", "adam",
               "--budget", "1e9", "--out", out]  # fmt: skip
    process = subprocess.Popen(
        [str(a) for a in command], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=hear_ctrl_c
    )
    deadline = time.monotonic() + 90
    while not (out / "checkpoint.pt").exists() and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    text, err = process.communicate(timeout=60)
    assert process.returncode == 130, err
    assert "Traceback" not in err and "stopped by the user" in text
    report = json.loads((out / "fit.json").read_text())
    assert report["status"] == "interrupted" and report["loss"] == min(loss for _, _, loss in report["history"])
    assert (out / "fitted.json").exists() and (out / "fitted.safetensors").exists()
