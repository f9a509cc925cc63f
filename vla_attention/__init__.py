"""Does a vision-language-action policy look, or does it read? Record its attention once, regroup it for months.

    import vla_attention as va

    run = va.open("runs/libero_10.zarr")    # a store, or several that are analysed as one; or va.example("cubes")
    run.analyze()["tasks"]                  # a polars frame; docs/python.md lists the other methods

    with va.record("run.zarr", policy, layout=va.layouts.smolvla(policy)) as run:    # docs/my-policy.md
        ...

Public names: `open`, `data`, `example`, `workers`, `OpenStores` and `language_test` (stage two); `record`, `inspect`,
`check_layout`, `layouts`, the parts of a `PolicyLayout`, `EffectSettings`, `Interventions` and `knockout` (stage one,
from your own code; it needs torch); `UserError` (the base of every error that a user can cause) and `__version__`.
`vla_attention.datasets` reads data sets of robots. This import loads neither torch nor zarr, polars or numpy.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vla_attention.schemas.errors import UserError

if TYPE_CHECKING:
    # What `__getattr__` gives, for type checkers and editors.
    from vla_attention import datasets as datasets
    from vla_attention.analyze.api import OpenStores as OpenStores
    from vla_attention.analyze.language_test import language_test as language_test
    from vla_attention.analyze.render.answer import Answer
    from vla_attention.capture.effects.arguments import EffectSettings as EffectSettings
    from vla_attention.capture.torch_policies import layouts as layouts
    from vla_attention.capture.torch_policies.inspect_calls import CallTable
    from vla_attention.capture.torch_policies.layout_check import check_layout as check_layout
    from vla_attention.capture.torch_policies.policy_layout import CallRule as CallRule
    from vla_attention.capture.torch_policies.policy_layout import CameraPicture as CameraPicture
    from vla_attention.capture.torch_policies.policy_layout import PolicyLayout as PolicyLayout
    from vla_attention.capture.torch_policies.policy_layout import PromptText as PromptText
    from vla_attention.capture.torch_policies.policy_layout import RecordedSite as RecordedSite
    from vla_attention.capture.torch_policies.record import record as record
    from vla_attention.schemas.interventions import Interventions as Interventions
    from vla_attention.schemas.interventions import knockout as knockout
    from vla_attention.schemas.layout import PatchGrid as PatchGrid
    from vla_attention.schemas.layout import SiteLayout as SiteLayout
    from vla_attention.schemas.layout import Span as Span

    __version__: str

#: Public names of the recorder by module. They are imported when they are used: the recorder needs torch.
_RECORDER = {
    "capture.effects.arguments": ("EffectSettings",),
    "capture.torch_policies.record": ("record",),
    "capture.torch_policies.layout_check": ("check_layout",),
    "capture.torch_policies.policy_layout": (
        "CallRule",
        "CameraPicture",
        "PolicyLayout",
        "PromptText",
        "RecordedSite",
    ),
    "schemas.interventions": ("Interventions", "knockout"),
    "schemas.layout": ("PatchGrid", "SiteLayout", "Span"),
}

__all__ = ["OpenStores", "UserError", "__version__", "data", "example", "inspect", "language_test", "open", "workers"]


def __dir__() -> list[str]:
    return [*__all__, "datasets", "layouts", *(name for names in _RECORDER.values() for name in names)]


def open(stores: str | Path | Sequence[str | Path]) -> OpenStores:
    """Open one store, or several that are analysed as one; returns what answers questions about them.

    >>> import vla_attention as va
    >>> run = va.open(store)
    >>> run.analyze()["tasks"].filter(layer="layers_avg")["scope"].to_list()
    ['task', 'task', 'all']

    Raises:
        StoreNotFound, StoreError: no store is there, or it cannot be read.
    """
    # Imported here: `import vla_attention` loads neither polars nor zarr.
    from vla_attention.analyze.api import open_stores

    return open_stores(stores)


def data(place: str | Path, num_episodes: int | None = None, encoder: Callable[[Any], Any] | None = None) -> Answer:
    """Return what the first pictures of a data set tell of its sentences, before anything is trained on it.

    `place`: a LeRobotDataset (a folder, `ORG/NAME` or `ORG/NAME@REVISION`) or a store. `num_episodes`: so many, evenly
    over all; 5,000 at most without it. `encoder`: one more look, from a picture (height, width, 3) uint8 to numbers, as
    the features of a network. Tables "pairs", "words", "looks" and "ways".

    >>> va.data(store)["ways"]["sentence"].len()
    2

    Raises:
        DataSetError, StoreError: it cannot be read.
        BadArgument: it has no pictures, or fewer than two sentences.
    """
    # Imported here: `import vla_attention` loads neither polars nor numpy.
    from vla_attention.analyze.commands.data import data as answer
    from vla_attention.analyze.core.data_episodes import read_episodes
    from vla_attention.analyze.render.answer import Answer

    return Answer.of(answer(read_episodes(place, num_episodes, encoder)))


def example(name: str) -> Path:
    """Return the path of a small store that is shipped: `cubes`, `cubes_one_colour` or `cubes_noise`.

    >>> run = va.open(va.example("cubes"))

    Raises:
        UserError: there is no such store.
    """
    # Imported here: `import vla_attention` loads little.
    from vla_attention.example_stores import example as example_there

    return example_there(name)


def workers(where: int | str) -> AbstractContextManager[None]:
    """Return a block within which episodes are worked on elsewhere; results are the same to the last bit.

    `where`: a number of processes on this machine, or the address of a running dask scheduler (docs/my-cluster.md). The
    processes do not run a script again that has no `if __name__ == "__main__":`.

    >>> with va.workers(2):
    ...     elsewhere = va.open(store).analyze()["tasks"]
    >>> elsewhere.equals(va.open(store).analyze()["tasks"])
    True

    Raises:
        BadArgument: fewer than one process, or no scheduler answers.
        MissingDependency: dask.distributed is not installed.
    """
    # Imported here: `import vla_attention` loads no numpy.
    from vla_attention.analyze.stores.parallel import workers as workers_there

    return workers_there(where)


def inspect(policy: object, call: Callable[[], object], *, first_row: Callable[[], object] | None = None) -> CallTable:
    """Return a table of every attention call that `call()` makes in a torch policy; printed, it fits a screen.

        va.inspect(policy, lambda: policy.select_action(batch))

    Calls that recording refuses are marked, with the reason. `first_row`: where `call` has a batch, the same call with
    the first row alone; calls whose first row is another one then (heads folded outside of the batch) are marked, too.

    Raises:
        NoAttention: no attention was seen.
        UserError: the policy cannot be watched; the sentence says why, and what to do.
    """
    # Imported here: `import vla_attention` loads no torch.
    inspect_calls = _module_of_the_recorder("capture.torch_policies.inspect_calls").inspect
    table: CallTable = inspect_calls(policy, call, first_row=first_row)
    return table


if not TYPE_CHECKING:  # else every misspelt name would be of type Any

    def __getattr__(name: str) -> Any:
        if name == "OpenStores":
            from vla_attention.analyze.api import OpenStores

            return OpenStores
        if name == "language_test":
            from vla_attention.analyze.language_test import language_test

            return language_test
        if name == "__version__":
            from importlib.metadata import version

            return version("vla-attention")
        if name == "datasets":
            from importlib import import_module

            return import_module("vla_attention.datasets")
        if name == "layouts":
            return _module_of_the_recorder("capture.torch_policies.layouts")
        for module, names in _RECORDER.items():
            if name in names:
                return getattr(_module_of_the_recorder(module), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def _module_of_the_recorder(name: str) -> Any:
    """A module that needs torch; raises `MissingDependency`, an ImportError, where there is none."""
    from importlib import import_module

    try:
        return import_module(f"vla_attention.{name}")
    except ModuleNotFoundError as error:
        if error.name != "torch":
            raise
        from vla_attention.schemas.errors import MissingDependency
        from vla_attention.schemas.install_line import install_line

        raise MissingDependency(
            f"torch is not installed, and va.record and va.inspect need it: {install_line('capture')}."
        ) from error
