"""`vla-attention` hands its arguments on, and says what there is."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.kit.archives import example_store
from vla_attention.__main__ import main
from vla_attention.schemas.install_line import install_line


def test_analyze_is_vla_analyze(capsys):
    assert main(["analyze", str(example_store("cubes")), "--list"]) == 0
    assert "touch the red cube" in capsys.readouterr().out


def test_capture_is_vla_capture(capsys):
    assert main(["capture", "tasks", "cubes"]) == 0
    assert "touch the red cube" in capsys.readouterr().out


@pytest.mark.parametrize(("word", "named"), [("anlyze", "'analyze'"), ("nothing\x1b[31m", "'nothing\\x1b[31m'")])
def test_a_mistake_is_named_in_one_line(word, named):
    done = subprocess.run([sys.executable, "-m", "vla_attention", word], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert named in done.stderr
    assert done.stderr.count("\n") == 1


def test_without_torch_a_capture_says_how_to_install_it(tmp_path):
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "from vla_attention.__main__ import main\n"
        f"sys.exit(main(['capture', 'pi', '--output', {str(tmp_path / 'new.zarr')!r}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert install_line("capture") in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "new.zarr").exists()


def test_without_torch_the_recorder_says_how_to_install_it():
    code = (
        "import sys; sys.modules['torch'] = None\n"
        "import vla_attention as va\n"
        "for use in (lambda: va.record, lambda: va.inspect(None, lambda: None)):\n"
        "    try:\n        use()\n"
        "    except ImportError as error:\n        print(type(error).__name__, error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    assert len(lines) == 2
    for line in lines:
        assert line.startswith("MissingDependency torch")
        assert install_line("capture") in line
