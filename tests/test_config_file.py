"""Settings: defaults, file, overrides; every mistake is named with its place; what is written reads back equal."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common.runtime.config_file import SettingsError, dump_settings, load_settings


@dataclass(frozen=True)
class Lens:
    focal_px: float = 500.0
    size: tuple[int, int] = (640, 480)


@dataclass(frozen=True)
class Link:
    mode: Literal["peer", "client"] = "peer"
    lease_ms: int = 3000
    connect: tuple[str, ...] = ()
    config: Path | None = None

    def __post_init__(self) -> None:
        if self.lease_ms <= 0:
            raise ValueError(f"lease_ms: {self.lease_ms} must be positive")


@dataclass(frozen=True)
class Root:
    site: str = "here"
    mirror: bool = False
    link: Link = field(default_factory=Link)
    lenses: tuple[Lens, ...] = ()
    weights: dict[str, float] = field(default_factory=dict)


def load(tmp_path: Path, text: str, overrides: dict[str, object] | None = None) -> Root:
    path = tmp_path / "settings.toml"
    path.write_text(text, "utf-8")
    return load_settings(Root, path, overrides)


def test_without_a_file_all_defaults_hold() -> None:
    assert load_settings(Root) == Root()


def test_file_overrides_defaults_and_the_command_line_overrides_the_file(tmp_path: Path) -> None:
    text = 'site = "lab"\n[link]\nlease_ms = 5000\nconnect = ["tcp/a:1"]\n'
    settings = load(tmp_path, text, {"link.lease_ms": 7000, "link.config": Path("z.json5")})
    assert settings == Root(site="lab", link=Link(lease_ms=7000, connect=("tcp/a:1",), config=Path("z.json5")))


def test_nested_lists_of_tables_and_dictionaries(tmp_path: Path) -> None:
    settings = load(tmp_path, "weights = {head = 3, hand = 0.5}\n[[lenses]]\nfocal_px = 400\nsize = [320, 240]\n")
    assert settings.lenses == (Lens(400.0, (320, 240)),)
    assert settings.weights == {"head": 3.0, "hand": 0.5}
    assert isinstance(settings.lenses[0].focal_px, float)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[link]\nlaese_ms = 1", "[link] laese_ms: unknown key; did you mean 'lease_ms'?"),
        ("zzz = 1", "zzz: unknown key; known here: site, mirror, link, lenses, weights"),
        ("[link]\nlease_ms = 'soon'", "[link] lease_ms: expected an integer, not 'soon'"),
        ("[link]\nlease_ms = true", "[link] lease_ms: expected an integer, not True"),
        ("[link]\nlease_ms = 1.5", "[link] lease_ms: expected an integer, not 1.5"),
        ("[link]\nlease_ms = 0", "[link] lease_ms: 0 must be positive"),
        ("[link]\nmode = 'router'", "[link] mode: expected one of 'peer', 'client', not 'router'"),
        ("[link]\nconnect = 'tcp/a:1'", "[link] connect: expected a list, not 'tcp/a:1'"),
        ("[link]\nconnect = [1]", "[link] connect[0]: expected a string, not 1"),
        ("link = 3", "link: expected a table, not 3"),
        ("mirror = 1", "mirror: expected true or false, not 1"),
        ("site = 1", "site: expected a string, not 1"),
        ("[[lenses]]\nsize = [1]", "[lenses[0]] size: expected a list of 2, not of 1"),
        ("[[lenses]]\nfocal_px = nan", "[lenses[0]] focal_px: expected a finite number, not nan"),
        ("[weights]\nhead = 'big'", "[weights] head: expected a number, not 'big'"),
        ("site = ", "not valid TOML"),
    ],
)
def test_mistakes_are_named_with_file_table_and_key(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(SettingsError) as caught:
        load(tmp_path, text)
    assert str(caught.value).startswith(f"{tmp_path / 'settings.toml'}: {complaint}")


def test_a_file_that_is_not_there_is_named() -> None:
    with pytest.raises(SettingsError, match=r"nowhere\.toml: No such file"):
        load_settings(Root, Path("nowhere.toml"))


def test_an_override_cannot_turn_a_value_into_a_table(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="site is not a table"):
        load(tmp_path, "site = 'a'", {"site.name": "b"})


texts = st.text(st.characters(codec="utf-8"), max_size=20)
floats = st.floats(allow_nan=False, allow_infinity=False)
trees: st.SearchStrategy[Any] = st.builds(
    Root,
    site=texts,
    mirror=st.booleans(),
    link=st.builds(
        Link,
        mode=st.sampled_from(["peer", "client"]),
        lease_ms=st.integers(1, 2**40),
        connect=st.lists(texts, max_size=3).map(tuple),
        config=st.none() | st.just(Path("some folder/z.json5")),
    ),
    lenses=st.lists(st.builds(Lens, floats, st.tuples(st.integers(0, 9), st.integers(0, 9))), max_size=2).map(tuple),
    weights=st.dictionaries(texts, floats, max_size=3),
)


@given(trees)
def test_dumped_settings_read_back_equal(tmp_path_factory: pytest.TempPathFactory, settings: Root) -> None:
    assert load(tmp_path_factory.getbasetemp(), dump_settings(settings)) == settings


@dataclass(frozen=True)
class Port:
    host: str = "here"
    number: int = 0


@dataclass(frozen=True)
class WithOwnDefault:
    port: Port = field(default_factory=lambda: Port(number=8080))


def test_a_table_named_in_part_keeps_the_rest_of_its_owners_default(tmp_path: Path) -> None:
    file = tmp_path / "settings.toml"
    file.write_text('[port]\nhost = "there"\n')
    assert load_settings(WithOwnDefault, file) == WithOwnDefault(Port("there", 8080))
