"""What can be wrong with a data set."""

from __future__ import annotations

from vla_attention.schemas.errors import UserError


class DataSetError(UserError, ValueError):
    """A data set that cannot be used as it is."""


class DataSetNotFound(DataSetError, FileNotFoundError):
    """There is no data set, or a file of it is missing."""


class UnsupportedDataSet(DataSetError):
    """A data set of another kind or version."""


class DamagedDataSet(DataSetError):
    """A file of a data set that cannot be read, or that contradicts the others."""


class UndecodableVideo(DataSetError):
    """A video whose pictures cannot be decoded."""
