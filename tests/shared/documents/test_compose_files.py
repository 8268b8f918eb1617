"""The compose files that are laid over docker-compose.yml name its services, and give the card what rays need."""

import re
from pathlib import Path
from typing import Any

import pytest
import yaml

ROOT = Path(__file__).parents[3]
OVERRIDES = ("docker-compose.bucket.yml", "docker-compose.gpu.yml")


def read_services(name: str) -> dict[str, Any]:
    """The services of a compose file, by their names."""
    services: dict[str, Any] = yaml.safe_load((ROOT / name).read_text())["services"]
    return services


@pytest.mark.parametrize("name", OVERRIDES)
def test_what_is_laid_over_the_farm_changes_services_that_it_has_and_says_how_it_is_used(name: str) -> None:
    assert read_services(name).keys() <= read_services("docker-compose.yml").keys()
    assert f"docker-compose -f docker-compose.yml -f {name} up" in (ROOT / name).read_text()


@pytest.mark.parametrize(
    ("service", "needs"), [("renderer", {"graphics", "compute", "utility"}), ("trainer", {"compute", "utility"})]
)
def test_a_service_on_a_card_reserves_it_with_the_parts_of_the_driver_that_it_uses(
    service: str, needs: set[str]
) -> None:
    described = read_services("docker-compose.gpu.yml")[service]
    (reserved,) = described["deploy"]["resources"]["reservations"]["devices"]
    assert reserved["driver"] == "nvidia"
    assert set(reserved["capabilities"]) == {"gpu", *needs}
    assert set(described["environment"]["NVIDIA_DRIVER_CAPABILITIES"].split(",")) == needs
    (card,) = reserved["device_ids"]
    (variable,) = re.fullmatch(r"\$\{([A-Z_]+):-0\}", card).groups()  # type: ignore[union-attr]
    assert f"`{variable}`" in (ROOT / "docs/configuration.md").read_text()


def test_kernels_outlive_the_worker_that_compiled_them_and_are_every_workers() -> None:
    renderer = read_services("docker-compose.yml")["renderer"]
    folder = Path(renderer["environment"]["DRJIT_CACHE_DIR"])
    assert "${PHOTONFARM_DATA:-./data}:/data" in renderer["volumes"]
    assert folder.parent == Path(renderer["environment"]["PHOTONFARM_STORE"]).parent == Path("/data")


def test_renderers_on_a_card_use_no_other_device() -> None:
    assert read_services("docker-compose.gpu.yml")["renderer"]["environment"]["PHOTONFARM_DEVICE"] == "cuda"
