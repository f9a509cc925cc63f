"""A folder that zarr writes in before one rename publishes it (`durable_files.publish`)."""

from __future__ import annotations

from typing import Any

from zarr.abc.store import Store
from zarr.core.buffer import Buffer
from zarr.storage import LocalStore


class UnpublishedFolder(LocalStore):
    """An existing folder, whose files are written where they stay.

    zarr's own store writes each file elsewhere, then links or renames it, which file systems without hard links refuse;
    and it makes a folder again that was moved away or deleted meanwhile, with all that is above it.
    """

    async def _open(self, **_: Any) -> None:
        if not self.root.is_dir():
            raise FileNotFoundError(2, "The folder was moved or deleted", str(self.root))
        await Store._open(self)

    async def set(self, key: str, value: Buffer) -> None:
        """Write a file, and the folders in this one that it needs."""
        for parent in [*(self.root / key).relative_to(self.root).parents][-2::-1]:
            (self.root / parent).mkdir(exist_ok=True)
        (self.root / key).write_bytes(value.to_bytes())

    async def set_if_not_exists(self, key: str, value: Buffer) -> None:
        """Write a file unless it exists; nobody else writes here."""
        if not (self.root / key).exists():
            await self.set(key, value)
