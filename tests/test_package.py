"""What is handed out: the wheel and the sdist hold what they must, and nothing else."""

import ast
import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from importlib.metadata import packages_distributions

import pytest
from source import FILES, ROOT, tree_of

import pdr_graph

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def build(source, out):
    """As pip does it, without a network: the sdist and the wheel of a folder, as paths."""
    command = [sys.executable, "-m", "hatchling", "build", "--directory", str(out)]
    subprocess.run(command, check=True, cwd=source, capture_output=True, timeout=120)
    return next(out.glob("*.tar.gz")), next(out.glob("*.whl"))


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    return build(ROOT, tmp_path_factory.mktemp("dist"))


def test_the_wheel_has_the_package_with_all_it_reads_and_no_tests(built):
    """Every file beside the code but what Python made itself; and scenarios with their plans, for a first walk."""
    here = {f.relative_to(ROOT).as_posix() for f in (ROOT / "pdr_graph").rglob("*") if f.is_file()}
    wanted = {name for name in here if "__pycache__" not in name}
    wanted |= {f"pdr_graph/{f.relative_to(ROOT)}" for f in (ROOT / "maps").iterdir()}
    with zipfile.ZipFile(built[1]) as wheel:
        found = {name for name in wheel.namelist() if ".dist-info/" not in name}
    assert found == wanted
    assert {"pdr_graph/py.typed", "pdr_graph/__init__.pyi"} <= found


def test_the_sdist_builds_the_same_wheel(built, tmp_path):
    """Bit for bit; and it has what its own tests read."""
    with tarfile.open(built[0]) as sdist:
        safely = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}  # Python 3.11.4 and newer have it
        sdist.extractall(tmp_path, **safely)
    (source,) = tmp_path.iterdir()
    assert source.name == f"pdr_graph-{pdr_graph.__version__}"
    needed = ("tests/conftest.py", "tests/test_api.py", "docs/accuracy.md", "scripts/demo", "LICENSE", "CITATION.cff")
    assert [name for name in needed if not (source / name).exists()] == []
    assert not list(source.rglob("*.pyc"))
    assert build(source, tmp_path / "dist")[1].read_bytes() == built[1].read_bytes()


def test_what_is_imported_is_a_dependency():
    """What stands at the head of a file must be there for all; what a function imports, for its extra at least.

    The server is imported by its verb alone, which names the extra that is missing.
    """

    def named(requirements):
        words = (word for line in requirements for word in re.findall(r"[\w-]+", line.split(">")[0]))
        return {word.lower().replace("_", "-") for word in words}  # dask[distributed] brings both

    core, extras = named(PROJECT["dependencies"]), PROJECT["optional-dependencies"]
    users = extras.keys() - {"test", "docs", "dev"}
    extra = named(line for name in users for line in extras[name])
    distributions = packages_distributions()
    for file in FILES:
        at_once = {id(node) for node in tree_of(file).body}
        for node in ast.walk(tree_of(file)):
            if isinstance(node, ast.Import):
                modules = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and not node.level:
                modules = [node.module or ""]
            elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "files":
                modules = [ast.literal_eval(node.args[0])]  # what lies in a package
            else:
                continue
            for top in {module.split(".")[0] for module in modules} - sys.stdlib_module_names - {"pdr_graph"}:
                needed = id(node) in at_once and file.parent.name != "serve"
                allowed = core if needed else core | extra
                assert named(distributions[top]) & allowed, f"{file.name} imports {top}"


WITHOUT_GTSAM = """import sys
class Refused:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] == "gtsam":
            raise ModuleNotFoundError(name, name=name)
sys.meta_path.insert(0, Refused())
from pdr_graph.__main__ import main
sys.argv[0] = "pdr-graph"
main()
"""


def test_smooth_needs_no_gtsam(arcade_walk, tmp_path):
    """Only live walks, whose smoother is iSAM2, and the export do."""
    plan, fixes = ("--map", arcade_walk / "plan.geojson"), ("--fixes", arcade_walk / "fixes.csv")
    line = [sys.executable, "-c", WITHOUT_GTSAM, "smooth", arcade_walk, *plan, *fixes, "--out", tmp_path / "out"]
    ended = subprocess.run(line, capture_output=True, text=True, timeout=240, check=False)
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("ok")
    ended = subprocess.run([*line[:3], "replay", *line[4:]], capture_output=True, text=True, timeout=240, check=False)
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert "gtsam>=4.3" in ended.stderr
