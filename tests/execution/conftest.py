"""The task and the policy that rollouts are tested with."""

from collections.abc import Iterator

import pytest
from hover import hover_policy, hover_scene

from rtc_cli.core.policy import Policy
from rtc_cli.tasks.batch import WorldBatch
from rtc_cli.tasks.scene import Scene


@pytest.fixture(scope="session")
def scene() -> Scene:
    return hover_scene()


@pytest.fixture(scope="session")
def policy(scene: Scene) -> Policy:
    return hover_policy(scene)


@pytest.fixture(scope="session")
def worlds(scene: Scene) -> Iterator[WorldBatch]:
    with WorldBatch(scene, 64) as batch:
        yield batch
