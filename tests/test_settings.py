"""Both daemons' settings and command lines: the examples in deploy/ are true, and mistakes are named."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from common.runtime.config_file import SettingsError, load_settings
from common.runtime.daemon_options import overrides
from receiver import cli as receive_cli
from receiver.config import ReceiverSettings
from scripts.make_certificates import make
from sender import cli as send_cli
from sender.config import SenderSettings

DEPLOY = Path(__file__).parents[1] / "deploy"
BIN = Path(sys.executable).parent
EXAMPLES = [(SenderSettings, "sender.toml"), (ReceiverSettings, "receiver.toml")]


@pytest.mark.parametrize(("settings", "name"), EXAMPLES)
def test_the_example_changes_nothing(settings, name):
    assert load_settings(settings, DEPLOY / name) == settings()


@pytest.mark.parametrize(("settings", "name"), EXAMPLES)
def test_every_commented_key_of_the_example_exists(settings, name, tmp_path):
    text = re.sub(r"(?m)^#(?=[a-z_]+ = )", "", (DEPLOY / name).read_text())
    active = tmp_path / name
    active.write_text(text)
    load_settings(settings, active)
    assert text.count(" = ") > 10


@pytest.mark.parametrize(
    ("toml", "message"),
    [
        ("camera = 3", "camera: unknown key"),
        ("[capture]\ncamras = 3", r"\[capture\] camras: unknown key; did you mean 'cameras'"),
        ('[capture]\ncameras = "four"', r"\[capture\] cameras: expected an integer"),
        ("[capture]\ncameras = 99", r"\[capture\] cameras: 99 is outside 1..16"),
        ('[capture]\nsource = "kinect"', "expected one of 'virtual', 'rig', 'recording'"),
        ('[capture]\nsource = "recording"', "needs a folder"),
        ("person = 300", "person: 300"),
        ('[link]\nlisten = ["127.0.0.1:7447"]', "listen: '127.0.0.1:7447' is not a locator"),
        ("[poses]\njpeg_quality = 5", "jpeg_quality: 5"),
        ("[poses]\nregion_weights = { tumb = 1 }", r"\[poses\] region_weights: no region 'tumb'"),
        ("[poses]\nregion_weights = { thumb = -1 }", "thumb = -1.* is outside"),
        ("[self_view]\nport = 0", r"\[self_view\] port: 0 is outside"),
        ('[link]\nmode = "client"\n[self_view]\nenabled = true', "self_view: needs a link of its own"),
        ('[link]\ncertificates = "c"', r"receivers: name the sites that may receive"),
        ('receivers = ["*"]\n[link]\ncertificates = "c"', r"receivers: '\*' has characters"),
        ('receivers = ["a"]\n[link]\ncertificates = "c"\nlisten = ["tcp/0.0.0.0:1"]', "would not be secured"),
        ('[link]\nlisten = ["0.0.0.0:7447"]', "is not a locator"),
        ('[link]\nconfig_file = "z.json5"\n[self_view]\nenabled = true', "self_view: name what Zenoh's own file"),
    ],
)
def test_a_mistake_is_named(toml, message, tmp_path):
    file = tmp_path / "sender.toml"
    file.write_text(toml)
    with pytest.raises(SettingsError, match=message):
        load_settings(SenderSettings, file)


def test_a_headless_receiver_has_no_window():
    options = receive_cli.parse_arguments(["--headless", "--window"])
    with pytest.raises(SettingsError, match=r"\[view\] window: a headless receiver has none"):
        load_settings(ReceiverSettings, None, overrides(options))


def test_the_command_line_goes_over_the_file(tmp_path):
    file = tmp_path / "receiver.toml"
    file.write_text('site = "lab"\n[view]\nheadless = false\n')
    options = receive_cli.parse_arguments(["-c", str(file), "--headless", "-e", "tcp/192.0.2.7:7447"])
    settings = load_settings(ReceiverSettings, options.config, overrides(options))
    assert (settings.site, settings.view.headless) == ("lab", True)
    assert settings.link.connect == ("tcp/192.0.2.7:7447",)


def test_a_secured_link_is_one_option_and_needs_no_protocol():
    given = overrides(send_cli.parse_arguments(["--certificates", "c", "-l", "0.0.0.0:7447", "--receiver", "lobby"]))
    settings = load_settings(SenderSettings, None, given)
    assert (settings.link.certificates, settings.link.listen) == (Path("c"), ("0.0.0.0:7447",))
    assert settings.receivers == ("lobby",)
    through_router = send_cli.parse_arguments(["--certificates", "c", "-m", "client", "-e", "hub.example:7447"])
    assert load_settings(SenderSettings, None, overrides(through_router)).receivers == ()


def test_a_recording_on_the_command_line_is_the_source():
    options = send_cli.parse_arguments(["--recording", "somewhere", "--as-fast-as-possible"])
    given = send_cli.source_of(overrides(options))
    settings = load_settings(SenderSettings, None, given)
    assert (settings.capture.source, settings.capture.realtime) == ("recording", False)


@pytest.mark.parametrize("command", ["telepose-send", "telepose-receive"])
def test_help_teaches_and_a_wrong_setting_is_one_line(command, tmp_path):
    shown = subprocess.run([BIN / command, "--help"], capture_output=True, text=True, timeout=30, check=True)
    assert "examples:" in shown.stdout
    file = tmp_path / "wrong.toml"
    file.write_text("sight = 3\n")
    failed = subprocess.run([BIN / command, "-c", file], capture_output=True, text=True, timeout=30, check=False)
    assert failed.returncode == 1
    assert failed.stderr.strip().splitlines() == [f"{command}: {file}: sight: unknown key; did you mean 'site'?"]


@pytest.mark.parametrize(
    ("command", "site", "complaint"),
    [
        (["telepose-send", "--receiver", "wall"], "lobby", "site: 'studio', but the certificate .* is of 'lobby'"),
        (["telepose-send", "--receiver", "wall"], "nowhere", "ca.pem: No such file or directory"),
        (["telepose-receive"], "nowhere", "ca.pem: No such file or directory"),
    ],
)
def test_a_certificate_that_does_not_fit_is_one_line(command, site, complaint, tmp_path):
    make(tmp_path, [("lobby", [])])
    name, *options = command
    options += ["--certificates", str(tmp_path / site), "--http-port", "0"]
    failed = subprocess.run([BIN / name, *options], capture_output=True, text=True, timeout=60, check=False)
    assert failed.returncode == 1
    (line,) = failed.stderr.strip().splitlines()
    assert re.search(complaint, line)
