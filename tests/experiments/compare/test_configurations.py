"""Configurations by name and from files, and what is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from client_sdk.frontend import FrontEndOptions
from rse_pf.errors import UsageError
from rse_pf.extensions.experiments.compare.configurations import BUILT_IN, configurations_of

toml = pytest.importorskip("tomllib", reason="Python 3.10 reads no TOML")


def written(folder: Path, name: str, text: str) -> str:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return str(path)


def refusal(word: str) -> UsageError:
    with pytest.raises(UsageError) as refused:
        configurations_of([word])
    assert "\n" not in refused.value.message
    assert refused.value.hint
    return refused.value


def test_every_name_of_the_help_is_a_configuration() -> None:
    names = [name.replace("-N", "-500") for name in BUILT_IN if name.islower() or name.endswith("-N")]

    found = configurations_of(names)

    assert [each.name for each in found] == names
    assert found[names.index("features-500")].frontend.features == 500
    assert found[names.index("features-500")].monocular.features == 500
    assert found[names.index("without-depth")].depth is False
    assert found[names.index("wide-baseline")].frontend == FrontEndOptions.wide_baseline()


def test_a_table_changes_options_of_a_base(tmp_path: Path) -> None:
    text = 'base = "wide-baseline"\ndepth = true\n[frontend]\nfeatures = 700\ninlier_px = 3\n'

    (found,) = configurations_of([written(tmp_path, "many.toml", text)])

    assert (found.name, found.depth) == ("many", True)
    assert (found.frontend.features, found.frontend.inlier_px, found.frontend.min_inliers) == (700, 3.0, 12)


def test_a_python_file_sets_options_and_may_import_its_neighbour(tmp_path: Path) -> None:
    written(tmp_path, "compared_neighbour.py", "MANY = 321\n")
    text = "from compared_neighbour import MANY\nfrontend = {'features': MANY}\n"

    (found,) = configurations_of([written(tmp_path, "mine.py", text)])

    assert (found.name, found.frontend.features, found.slots) == ("mine", 321, {})


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.toml", "features = 500\n", "sets features, which is no part"),
        ("a.toml", "fronted = 500\n", "sets fronted"),
        ("a.toml", "[frontend\n", "is not TOML"),
        ("a.toml", "base = " + "[" * 3000 + "]" * 3000, "is not TOML"),
        ("a.toml", ".".join("a" * 8000) + " = 1", "sets a, which is no part"),
        ("a.toml", ".".join("a" * 50_000) + " = 1", "longer than 16384 bytes"),
        ("a.toml", "[frontend]\nfeatures = 'many'\n", "frontend.features = 'many' is no int"),
        ("a.toml", "[frontend]\nfeatures = true\n", "frontend.features = True is no int"),
        ("a.toml", "[frontend]\nfeatures = 5\n", "must not be below"),
        ("a.toml", "[monocular]\nlimits = 5\n", "monocular has no option limits"),
        ("a.toml", "frontend = 5\n", "frontend is no table"),
        ("a.toml", "base = 'fast'\n", "no configuration 'fast'"),
        ("a.toml", "depth = 1\n", "neither true nor false"),
        ("a.py", "x = 1\n", "sets nothing"),
        ("a.py", "features = 3\n", "features is no function"),
        ("a.py", "\n1 / 0\n", "line 2: ZeroDivisionError: division by zero"),
        ("a.py", "import nothing_of_this_name\n", "line 1: ModuleNotFoundError"),
        ("a.py", "raise SystemExit(3)\n", "line 1: SystemExit: 3"),
        ("a.py", "raise ValueError('two\\nlines')\n", "line 1: ValueError: two"),
    ],
)
def test_a_broken_file_is_one_line_with_a_hint(tmp_path: Path, name: str, text: str, says: str) -> None:
    word = written(tmp_path, name, text)

    refused = refusal(word)

    assert says in refused.message
    assert word in refused.message


def test_a_function_of_a_module_is_a_configuration_as_for_the_demo(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path, "compared_features.py", "def mine(rgb): ...\n")
    monkeypatch.chdir(tmp_path)

    (found,) = configurations_of(["compared_features:mine"])

    assert (found.name, found.source, list(found.slots)) == ("compared_features:mine", path, ["features"])
    assert "has no function other" in refusal("compared_features:other").message
