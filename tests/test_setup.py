"""What `make demo` and `make test` set up: the lock files, the Pythons, the package."""

import re
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
LOCKS = {name: (ROOT / name).read_text() for name in ("requirements.lock", "requirements-dev.lock")}


def pinned(lock):
    """The packages of a lock file, by name, with their versions."""
    return dict(re.findall(r"^([A-Za-z0-9._-]+)==([^ ;]+)", LOCKS[lock], re.MULTILINE))


def names(requirements):
    """Names of what is required, without versions, and without catstream's own extras."""
    found = {re.match(r"[\w.-]+", requirement)[0].lower() for requirement in requirements}
    return found - {"catstream"}


def test_runtime_and_test_dependencies_are_in_separate_lock_files():
    project = PROJECT["project"]
    extras = project["optional-dependencies"]
    run, test = pinned("requirements.lock"), pinned("requirements-dev.lock")
    assert names([*project["dependencies"], *extras["view"], *PROJECT["build-system"]["requires"]]) <= set(run)
    assert names(extras["dev"]) <= set(run) | set(test)
    conditional = set(re.findall(r"^([\w.-]+)==\S+ ;", LOCKS["requirements.lock"], re.MULTILINE))
    assert set(run) & set(test) <= conditional  # a test may need on every Python what others need on some only
    assert not {"pytest", "mypy", "mkdocs", "pyarrow"} & set(run)


@pytest.mark.parametrize("lock", LOCKS)
def test_a_lock_has_hashes_for_each_package_one_version_for_all_pythons_and_no_index(lock):
    entries = re.split(r"^(?=\S+==)", LOCKS[lock], flags=re.MULTILINE)[1:]
    assert all("--hash=sha256:" in entry for entry in entries)
    assert len(entries) == len(pinned(lock))
    assert "://" not in LOCKS[lock]


def test_sdist_and_wheel_are_built_without_a_warning_with_the_page_of_the_view(tmp_path):
    for name in ("pyproject.toml", "MANIFEST.in", "README.md", "LICENSE", "catstream", "services", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    build = "import setuptools.build_meta as build; build.build_sdist('dist'); build.build_wheel('dist')"
    done = subprocess.run([sys.executable, "-c", build], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert not re.findall(r".*(?:Warning|absent from|deprecated).*", done.stdout + done.stderr)
    (wheel,), (sdist,) = (tmp_path / "dist").glob("*-py3-none-any.whl"), (tmp_path / "dist").glob("*.tar.gz")
    page = {f"catstream/web/page/{path.name}" for path in (ROOT / "catstream" / "web" / "page").iterdir()}
    packed = set(zipfile.ZipFile(wheel).namelist())
    content = {*page, "catstream/py.typed", "catstream/processes/detector.py"}
    assert content <= packed
    with tarfile.open(sdist) as archive:
        files = {name.partition("/")[2] for name in archive.getnames()}
    assert content <= files
    assert not [name for name in files if name.startswith(("services", "tests"))]


def test_every_package_is_installed():
    packages = {".".join(file.relative_to(ROOT).parent.parts) for file in (ROOT / "catstream").rglob("__init__.py")}
    assert packages == {*PROJECT["tool"]["setuptools"]["packages"]}


def test_an_editable_install_is_found_beside_the_caches_that_an_uninstalled_one_left(tmp_path):
    for name in ("pyproject.toml", "README.md", "LICENSE", "catstream"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / "site" / "catstream" / "features" / "__pycache__").mkdir(parents=True)
    build = "import setuptools.build_meta as build; build.build_editable('dist')"
    subprocess.run([sys.executable, "-c", build], cwd=tmp_path, capture_output=True, check=True)
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    zipfile.ZipFile(wheel).extractall(tmp_path / "site")
    find = f"import site; site.addsitedir({str(tmp_path / 'site')!r}); import catstream; print(catstream.__file__)"
    found = subprocess.run([sys.executable, "-S", "-c", find], capture_output=True, text=True, cwd="/", check=False)
    assert found.stdout.strip() == str(tmp_path / "catstream" / "__init__.py"), found.stderr
