"""The page as a folder of plain files, for any web server that sends parts of files (range requests)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path

from vla_attention.analyze.render.files import write_text, writing
from vla_attention.analyze.view.paths import PAGE_FILES, STORES_DOCUMENT
from vla_attention.analyze.view.served_stores import ServedStore, stores_document
from vla_attention.schemas.errors import BadArgument, listing
from vla_attention.schemas.stores.episode_files import foreign_in_episode, foreign_in_store
from vla_attention.schemas.stores.reader import Store
from vla_attention.schemas.stores.store_format import STORE_SUFFIX
from vla_attention.schemas.stores.store_place import refuse_in_store
from vla_attention.schemas.stores.store_url import HubAddress, StorePlace, StoreUrl

#: Where browsers of others find the hub.
HUB = "https://huggingface.co"


def check_site(folder: Path, stores: Sequence[StorePlace]) -> None:
    """Raise `BadArgument` unless a site of these stores can be written into a folder.

    An existing folder is written into only if it is empty or holds such a site.
    """
    refuse_in_store(folder, "write a site into")
    if folder.suffix == STORE_SUFFIX or (folder / "zarr.json").exists():
        raise BadArgument(f"Cannot write a site into {folder}: it is a store, or named like one; give another folder.")
    if folder.exists() and not folder.is_dir():
        raise BadArgument(f"Cannot write a site into {folder}: it is a file; give a folder.")
    if folder.is_dir() and any(folder.iterdir()) and not (folder / STORES_DOCUMENT).is_file():
        raise BadArgument(f"Cannot write a site into {folder}: it holds other files; give an empty or a new folder.")
    for store in stores:
        if isinstance(store, StoreUrl):
            web_address(store)


def check_uploads(folder: Path, stores: Sequence[Store]) -> None:
    """Raise `BadArgument` where an upload that follows links would publish more than a site of these stores.

    A site has links to the stores of this machine, so that whoever uploads it has to follow links.
    """
    for store in stores:
        more = [*foreign_in_store(store), *(file for episode in store.episodes for file in foreign_in_episode(episode))]
        if more:
            raise BadArgument(
                f"Cannot write a site of {store.path}: {listing(more, 5)} would be published with it, and "
                f"{'is' if len(more) == 1 else 'are'} no part of the store. vla-attention store copy {store.path} "
                "NAME.zarr makes a store without such files and links; or remove them."
            )
    links = [
        entry.name if place == folder else f"{place.name}/{entry.name}"
        for place in (folder, folder / "stores")
        if place.is_dir()
        for entry in place.iterdir()
        if entry.is_symlink() and not (place.name == "stores" and entry.name.isdecimal())
    ]
    if links:
        raise BadArgument(
            f"Cannot write a site into {folder}: it has the {'link' if len(links) == 1 else 'links'} "
            f"{listing(sorted(links), 5)}, and an upload that follows links would publish what is there; remove them."
        )


def web_address(place: StoreUrl) -> str:
    """The address under which a browser reads the files of a store; ends with /.

    Raises:
        BadArgument: browsers cannot read addresses of this kind.
    """
    if place.protocol == "hf":
        return f"{HubAddress.of(place.url).file_address(HUB)}/"
    if place.protocol in ("http", "https"):
        return f"{place.url.rstrip('/')}/"
    raise BadArgument(
        f"Browsers cannot read {place}: give its address as https://..., or copy the store here "
        f"(vla-attention store copy {place} NAME.zarr) and upload it with the site."
    )


def write_site(folder: Path, stores: Sequence[ServedStore]) -> str:
    """Write the page, its documents and links to the stores of this machine; returns what is to be uploaded, in words.

    The summaries must be complete.
    """
    document = stores_document(stores)
    page = files("vla_attention.analyze.view") / "bundle"
    uploads = []
    with writing("site", folder, instead="another --site"):
        (folder / "stores").mkdir(parents=True, exist_ok=True)
        _remove_earlier(folder / "stores", len(stores))
        for number, (store, entry) in enumerate(zip(stores, document["stores"], strict=True)):
            link = folder / "stores" / str(number)
            if link.is_symlink():
                link.unlink()
            elif link.exists():
                raise BadArgument(f"{link} is no link, so it is not replaced; remove it, or give another --site.")
            if isinstance(store.place, StoreUrl):
                entry["root"] = web_address(store.place)
            else:
                link.symlink_to(store.place.resolve(), target_is_directory=True)
                uploads.append(f"stores/{number} (a link to {store.place})")
            summary = json.dumps(store.summary.document(), allow_nan=False)
            write_text(folder / entry["summary"], summary + "\n")
        write_text(folder / STORES_DOCUMENT, json.dumps(document, indent=1) + "\n")
        for name in PAGE_FILES:
            write_text(folder / name, (page / name).read_text(encoding="utf-8"))
    return _uploads(folder, uploads, stores)


def _remove_earlier(folder: Path, count: int) -> None:
    """Remove the links and summaries of stores that an earlier site in this place had beyond the first `count`."""
    for entry in folder.iterdir():
        number, _, rest = entry.name.partition(".")
        is_ours = entry.is_symlink() if not rest else rest == "summary.json" and entry.is_file()
        if is_ours and number.isdecimal() and number.isascii() and int(number) >= count:
            entry.unlink()


def _uploads(folder: Path, uploads: Sequence[str], stores: Sequence[ServedStore]) -> str:
    lines = [f"{folder}: a page for any web server that sends parts of files (range requests)."]
    if uploads:
        lines.append(f"Upload the folder with what its links lead to: {', '.join(uploads)}.")
        lines.append(f"For instance: rsync -rL {folder}/ HOST:PATH")
    elsewhere = ", ".join(str(store.place) for store in stores if isinstance(store.place, StoreUrl))
    if elsewhere:
        lines.append(
            f"The page reads {elsewhere} there; that server has to let other sites read parts of files (CORS)."
        )
    return "\n".join(lines)
