"""The tasks as Gymnasium environments; needs the extra `rtc-cli[gym]`.

Importing this module registers `rtc/<Task>-v0` for every task that is installed, such as
`rtc/Catcher-v0` or `rtc/LunarLander-v0`, and `rtc/Task-v0`, which takes any task by name::

    import gymnasium
    import rtc_cli.gym

    env = gymnasium.make("rtc/Catcher-v0", render_mode="rgb_array")
    env = gymnasium.make("rtc/Task-v0", task="my_plugin_task")
    envs = gymnasium.make_vec("rtc/Catcher-v0", num_envs=64)

Gymnasium since 1.0 loads no plugins by itself; without an import of one's own the module's name
goes in front: `gymnasium.make("rtc_cli.gym:rtc/Catcher-v0")`.
"""

from __future__ import annotations

try:
    import gymnasium
except ModuleNotFoundError as error:
    raise ModuleNotFoundError(
        'rtc_cli.gym needs Gymnasium: pip install "rtc-cli[gym]"', name=error.name
    ) from error

from rtc_cli.gym.env import TaskEnv
from rtc_cli.gym.vector import TaskVectorEnv
from rtc_cli.tasks import list_tasks

__all__ = ["TaskEnv", "TaskVectorEnv", "env_id"]


def env_id(task: str) -> str:
    """Gymnasium's id of a task: `lunar_lander` -> `rtc/LunarLander-v0`."""
    return f"rtc/{''.join(part.capitalize() for part in task.split('_'))}-v0"


def _register(name: str, **kwargs: str) -> None:
    if name not in gymnasium.registry:
        gymnasium.register(
            name,
            entry_point=f"{TaskEnv.__module__}:{TaskEnv.__name__}",
            vector_entry_point=f"{TaskVectorEnv.__module__}:{TaskVectorEnv.__name__}",
            kwargs=kwargs,
        )


_register("rtc/Task-v0")
for _task in list_tasks():
    _register(env_id(_task), task=_task)
