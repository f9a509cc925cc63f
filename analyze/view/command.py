"""`vla-analyze view`: a local page on which the attention of a store is explored, or the same page as a static site."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from vla_attention.schemas.command_line import OneSentenceParser
from vla_attention.schemas.stores.store_url import store_place

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vla_attention.analyze.view.served_stores import ServedStore
    from vla_attention.schemas.stores.reader import Store
    from vla_attention.schemas.stores.store_url import StorePlace

_EXAMPLES = """examples:
  vla-attention view runs/cubes.zarr
  vla-attention view runs/cubes.zarr reruns/cubes/no_text.zarr         a run beside its rerun
  vla-attention view hf://datasets/ORG/NAME/libero_10.zarr
  vla-attention view runs/cubes.zarr --port 8765 --no-open           on another machine, with ssh -L 8765:127.0.0.1:8765
  vla-attention view runs/cubes.zarr --port 8765 --allow-host hub.example.org      behind a proxy, as JupyterHub
  vla-attention view runs/cubes.zarr --output public/cubes             a folder for a web server

The page is served to this machine only, to whoever has the printed link, until Ctrl-C. It asks nothing of any other
place. With the same stores and the same --port the link stays the same.
"""


def build_parser() -> argparse.ArgumentParser:
    """The parser of `vla-attention view STORE ...`."""
    from pathlib import Path

    parser = OneSentenceParser(
        prog="vla-attention view",
        description="Explore attention in the browser: episodes, pictures, words, layers and heads, groups, two runs "
        "side by side.",
        epilog=_EXAMPLES,
    )
    parser.add_argument("stores", nargs="+", type=store_place, metavar="STORE", help="NAME.zarr or addresses")
    parser.add_argument("--port", type=int, default=0, metavar="N", help="port of the page (default: any free one)")
    parser.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME",
        help="also answer under this host's name, that of a proxy (JupyterHub, Open OnDemand); may be repeated",
    )
    parser.add_argument("--no-open", action="store_true", help="print the link only")
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FOLDER",
        help="write the page, and links to the stores, into a folder that any web server can serve, and stop",
    )
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C, or write it."""
    from contextlib import ExitStack

    from vla_attention.analyze.view.served_stores import ServedStore
    from vla_attention.analyze.view.static_site import check_site, check_uploads
    from vla_attention.analyze.view.summaries import Summary
    from vla_attention.schemas.stores.reader import open_store

    if arguments.output is not None:
        check_site(arguments.output, arguments.stores)
    places: list[StorePlace] = list(dict.fromkeys(arguments.stores))
    with ExitStack() as stack:
        stores = [ServedStore(open_store(place), stack.enter_context(Summary())) for place in places]
        if arguments.output is not None:
            check_uploads(arguments.output, [store.store for store in stores])
        for store in stores:
            store.summary.begin(store.store)
        if arguments.output is not None:
            _write(arguments, stores)
        else:
            _serve(arguments, stores)
    return 0


def _write(arguments: argparse.Namespace, stores: Sequence[ServedStore]) -> None:
    import warnings

    from vla_attention.analyze.view.static_site import write_site
    from vla_attention.schemas.errors import Note

    for store in stores:
        if failed := store.summary.wait():
            warnings.warn(f"Not every episode of {store.place} has numbers: {failed}", Note, stacklevel=2)
    print(write_site(arguments.output, stores))


def _notes(stores: Sequence[Store]) -> tuple[str, ...]:
    """What is said of the runs before the page opens, which neither damaged episodes nor a slow address may delay."""
    from contextlib import suppress
    from pathlib import Path

    from vla_attention.analyze.stores.run_notes import change_notes, prompt_notes
    from vla_attention.schemas.errors import UserError

    readable = []
    for store in stores:
        for episode in store.episodes if isinstance(store.path, Path) else ():
            with suppress(UserError):
                if episode.attributes.prompts:
                    readable.append((store, episode))
    return (*change_notes(stores), *prompt_notes(readable))


def _serve(arguments: argparse.Namespace, stores: Sequence[ServedStore]) -> None:
    from vla_attention.analyze.render.browser import open_in_browser
    from vla_attention.analyze.view.server import ViewerServer

    with ViewerServer(stores, arguments.port, allow_hosts=arguments.allow_host, keep_link=True) as server:
        again = f"; with --port {server.port} its link stays the same" if server.keeps_link else ""
        # At once, also into a file that somebody follows.
        for line in _notes([store.store for store in stores]):
            print(f"note: {line}")
        print(f"The page: {server.link}\nIt is served to this machine only, until Ctrl-C{again}.", flush=True)
        if arguments.allow_host:
            print(
                f"Behind a proxy: its address of port {server.port}, and then {server.token}/ (JupyterHub: "
                f"https://{arguments.allow_host[0]}/user/NAME/proxy/{server.port}/{server.token}/).",
                flush=True,
            )
        if not arguments.no_open:
            open_in_browser(server.link)
        server.serve_forever()
