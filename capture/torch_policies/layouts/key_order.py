"""Spans of a site, one after another, with the role of each."""

from __future__ import annotations

from vla_attention.capture.torch_policies.policy_layout import RecordedSite
from vla_attention.schemas.layout import PatchGrid, SiteLayout, Span, SpanKind


class KeyOrder:
    """Collects a site's spans in the order of its keys."""

    def __init__(self) -> None:
        self.spans: list[Span] = []
        self.roles: dict[str, str] = {}

    @property
    def num_keys(self) -> int:
        """Number of keys so far."""
        return self.spans[-1].stop if self.spans else 0

    def add(self, name: str, kind: SpanKind, count: int, role: str) -> None:
        """Add `count` keys of one kind; none, no span."""
        if count:
            self.spans.append(Span(name, kind, self.num_keys, self.num_keys + count))
            self.roles[name] = role

    def add_picture(
        self, camera: str, rows: int, columns: int, height: int, width: int, role: str = "image", *, named: bool = True
    ) -> None:
        """Add a camera's patches, row by row; `named` False: of a picture that is no camera's (an empty view)."""
        start = self.num_keys
        grid = PatchGrid(rows, columns, height, width)
        stop = start + grid.num_patches
        self.spans.append(Span(camera, "image", start, stop, camera if named else None, grid if named else None))
        self.roles[camera] = role

    def add_growing(self, name: str, count: int, offset: int = 0) -> None:
        """Add the keys of generated tokens: action query q sees the first q + `offset`."""
        if count:
            start = self.num_keys
            self.spans.append(Span(name, "action", start, start + count, growing=True, growing_offset=offset))
            self.roles[name] = "action"

    def site(
        self,
        name: str,
        queries: tuple[int, int | None],
        *,
        layers: tuple[int, ...] = (),
        heads: int = 0,
        projection: str | None = None,
        variable: str | None = None,
    ) -> RecordedSite:
        """Return the site with these spans; arguments as in `RecordedSite` and `SiteLayout`."""
        keys = SiteLayout(name, tuple(self.spans), layers=layers, heads=heads)
        return RecordedSite(keys, queries, dict(self.roles), projection, variable)
