"""Dockerfile and compose.yaml name what there is; no container is started."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def instructions(name):
    """The arguments of an instruction of the Dockerfile, a line each."""
    return re.findall(rf"^{name} (.+)$", (ROOT / "Dockerfile").read_text(), re.MULTILINE)


def test_the_image_installs_the_package_and_its_command():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (extra,) = re.findall(r"\"\.\[(\w+)\]\"", "\n".join(instructions("RUN")))
    assert extra in project["optional-dependencies"]
    assert instructions("ENTRYPOINT") == ['["qfolio"]']
    assert "qfolio" in project["scripts"]
    (user,) = instructions("USER")
    assert user != "root"
    sources = [source for line in instructions("COPY") for source in line.split()[:-1]]
    allowed = (ROOT / ".dockerignore").read_text().split()
    assert all((ROOT / source).exists() and f"!{source}" in allowed for source in sources)
    needed = {"src", "pyproject.toml", project["readme"], *project["license-files"]}
    assert set(sources) == needed


@pytest.fixture
def services():
    yaml = pytest.importorskip("yaml")
    return yaml.safe_load((ROOT / "compose.yaml").read_text())["services"]


@pytest.mark.filterwarnings("default")  # Ray's own
def test_rays_commands_have_these_options(services):
    scripts = pytest.importorskip("ray.scripts.scripts")
    check = services["head"]["healthcheck"]["test"]
    assert check[:2] == ["CMD", "ray"]
    for command, *options in (
        services["head"]["command"],
        services["worker"]["command"],
        check[2:],
    ):
        known = {name for one in scripts.cli.commands[command].params for name in one.opts}
        assert {option.partition("=")[0] for option in options} <= known
    assert services["head"]["entrypoint"] == services["worker"]["entrypoint"] == ["ray"]


def test_the_addresses_agree(services):
    head = dict(option.partition("=")[::2] for option in services["head"]["command"])
    worker = dict(option.partition("=")[::2] for option in services["worker"]["command"])
    assert worker["--address"] == f"head:{head['--port']}"
    shown = (ROOT / "compose.yaml").read_text() + (
        ROOT / "docs" / "guides" / "machines.md"
    ).read_text()
    client = head["--ray-client-server-port"]
    assert set(re.findall(r"ray://head:(\d+)", shown)) == {client}
    assert services["head"]["ports"] == [f"127.0.0.1:{client}:{client}"]  # of this machine only
    assert {service["image"] for service in services.values()} == {"qfolio"}
