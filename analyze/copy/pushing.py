"""Uploading a packed store to the Hugging Face hub, with a dataset card that says what the store holds."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vla_attention.analyze.show.numbers import plural, solved_text
from vla_attention.analyze.stores.contents import protocol_text
from vla_attention.schemas.command_line import format_bytes
from vla_attention.schemas.errors import BadArgument, MissingDependency, listing
from vla_attention.schemas.safe_text import visible
from vla_attention.schemas.stores.packed_index import INDEX_FILE
from vla_attention.schemas.stores.reader import Store, open_store
from vla_attention.schemas.stores.remote_source import RemoteFailure
from vla_attention.schemas.stores.store_format import EPISODES_GROUP, STORE_SUFFIX, StoreError
from vla_attention.schemas.stores.store_url import HUB_PROTOCOL, HubAddress

#: Files of one commit; the hub advises against thousands.
_FILES_A_COMMIT = 200
CARD = "README.md"


def check_push(address: str) -> HubAddress:
    """Where to upload to; raises `BadArgument` for another address than a NAME.zarr in a data set of the hub."""
    expected = "expected hf://datasets/ORG/NAME/FILE.zarr"
    if not address.startswith(HUB_PROTOCOL):
        raise BadArgument(f"Cannot push to {address}: {expected}.")
    place = HubAddress.of(address)
    if place.kind != "datasets" or not place.path.endswith(STORE_SUFFIX):
        raise BadArgument(f"Cannot push to {address}: {expected}.")
    _client()
    return place


def push_store(path: Path, place: HubAddress) -> str:
    """Upload the packed store at `path`; returns a sentence that says what was done.

    Episodes go first and the index last: a reader never finds an index of what is not there. A card that the data set
    has already is left as it is.

    Raises:
        StoreError: the store is not packed, or one of its files is a link.
        RemoteFailure: the hub refuses.
    """
    store = open_store(path)
    if not (path / INDEX_FILE).is_file():
        raise StoreError(f"{path} is not packed; vla-attention copy --packed makes a packed copy.")
    hub = _client()
    api = hub.HfApi()
    files = [
        path / "zarr.json",
        path / EPISODES_GROUP / "zarr.json",
        *(Path(str(one.folder)) for one in store.episodes),
    ]
    if links := [str(file.relative_to(path)) for file in (*files, path / INDEX_FILE) if file.is_symlink()]:
        raise StoreError(
            f"Cannot upload {path}: {listing(links, 5)} in it {'is a link' if len(links) == 1 else 'are links'}, and "
            "what a link leads to is not published; make the packed copy again."
        )
    try:
        api.create_repo(place.repository, repo_type="dataset", exist_ok=True)
        for first in range(0, len(files), _FILES_A_COMMIT):
            some = files[first : first + _FILES_A_COMMIT]
            _commit(hub, api, place, {file: f"{place.path}/{file.relative_to(path).as_posix()}" for file in some})
        last: dict[Any, str] = {path / INDEX_FILE: f"{place.path}/{INDEX_FILE}"}
        has_card = api.file_exists(place.repository, CARD, repo_type="dataset", revision=place.revision)
        if not has_card:
            last[dataset_card(store, place).encode()] = CARD
        _commit(hub, api, place, last)
    except Exception as error:  # the client has many classes of its own
        if isinstance(error, (StoreError, BadArgument)):
            raise
        raise RemoteFailure(
            f"The hub did not take {path} for {place}: {visible(str(error).partition(chr(10))[0])}. Log in with "
            "`hf auth login`, check that you may write there, and run the same command again: what is there is not "
            "sent twice."
        ) from None
    card = f"; its {CARD} is left as it was" if has_card else ""
    return f"{place}: {plural(len(store.episodes), 'episode')} in {plural(len(files) + 1, 'file')}{card}."


def dataset_card(store: Store, place: HubAddress) -> str:
    """The card of a data set that holds a packed store."""
    root = store.attributes
    recording, policy = root.recording, root.policy
    episodes = [episode.attributes for episode in store.episodes]
    size = sum(episode.source.size(file) for episode in store.episodes for file in episode.files.records)
    tasks = {one.task_id: one.instruction for one in episodes}
    omitted = root.provenance.get("copied_without", "")
    pictures = any(name.startswith("frames/") for one in episodes for name in one.arrays)
    lines = [
        "---",
        "tags:",
        "- robotics",
        "- vision-language-action",
        "- attention",
        "- vla-attention",
        f"pretty_name: {_yaml(f'Attention of {policy.name} in {store.suite}')}",
        "---",
        "",
        f"# Attention of {_plain(policy.name)} in {_plain(store.suite)}",
        "",
        "Attention rows of the action queries of a vision-language-action policy, recorded at every policy call "
        "(replan) of simulated or replayed episodes with vla-attention. One zip an episode, without compression; any "
        "reader of Zarr v3 opens a zip.",
        "",
        "| | |",
        "|---|---|",
        f"| policy | {_plain(policy.name)} ({_plain(policy.family)}), weights {policy.digest[:16]}"
        f"{', UNTRAINED random weights' if policy.untrained else ''} |",
        f"| run | suite {_plain(store.suite)}, protocol {_plain(protocol_text(root.protocol))} |",
        f"| episodes | {plural(len(episodes), 'episode')} of {plural(len(tasks), 'task')} "
        f"({solved_text(one.success for one in episodes)}), {sum(one.num_replans for one in episodes)} replans, "
        f"{format_bytes(size)} |",
        f"| layers | {listing(recording.layer_labels, 40)} of {policy.num_layers} |",
        f"| denoise steps | {listing(recording.denoise_steps, 40)} of {policy.num_denoise_steps} |",
        f"| heads | {listing(recording.heads, 40)} |",
        f"| sites | {_plain(listing(f'{site.name} ({site.num_keys} keys)' for site in root.sites))} |",
        f"| precision | {recording.mantissa_bits} mantissa bits; queries: {recording.queries} |",
        f"| pictures | {'yes' if pictures else 'no'} |",
        f"| contributions | {'yes' if recording.contributions else 'no'} |",
        *([f"| left out of this copy | {_plain(omitted)} |"] if omitted else []),
        f"| changed in the policy | {'nothing' if root.interventions.is_none else _plain(root.interventions.name)} |",
        "",
        "## Tasks",
        "",
        *(f"- {task}: {_plain(text)}" for task, text in sorted(tasks.items())),
        "",
        "## Reading it",
        "",
        "```bash",
        "pip install 'vla-attention[remote]'",
        f"vla-attention analyze {place}             # only the bytes that the question needs are fetched",
        f"vla-attention verify {place}",
        "```",
        "",
    ]
    return "\n".join(lines)


def _commit(hub: Any, api: Any, place: HubAddress, files: dict[Any, str]) -> None:
    """Upload files (paths, or bytes) under their names in the data set."""
    operations = [
        hub.CommitOperationAdd(path_in_repo=name, path_or_fileobj=str(file) if isinstance(file, Path) else file)
        for file, name in files.items()
    ]
    api.create_commit(
        place.repository,
        operations,
        commit_message=f"{place.path}: {plural(len(operations), 'file')} of a store of attention",
        repo_type="dataset",
        revision=place.revision,
    )


def _client() -> Any:
    try:
        import huggingface_hub
    except ImportError:
        raise MissingDependency(
            "Uploading to the hub needs huggingface_hub, which is not installed; pip install 'vla-attention[remote]'."
        ) from None
    return huggingface_hub


def _plain(text: str) -> str:
    """Text of a store in a table of Markdown: no markup, one line."""
    signs = {ord(sign): f"&#{ord(sign)};" if sign in "<>|&" else f"\\{sign}" for sign in "\\`*_{}[]<>#|$&!"}
    return visible(text).translate(signs)


def _yaml(text: str) -> str:
    return '"' + visible(text).replace("\\", "\\\\").replace('"', '\\"') + '"'
