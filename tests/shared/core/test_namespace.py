import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]


def test_no_distribution_closes_the_namespace() -> None:
    assert not [*ROOT.glob("shared/photonfarm/__init__.py"), *ROOT.glob("services/*/photonfarm/__init__.py")]


def test_submitting_needs_neither_mitsuba_nor_torch() -> None:
    code = (
        "import sys; from photonfarm.cli.main import main\n"
        "try: main(['submit', '--help'])\n"
        "except SystemExit: pass\n"
        "sys.exit(bool({'mitsuba', 'drjit', 'torch'} & set(sys.modules)))"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).returncode == 0
