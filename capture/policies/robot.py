"""Robots of data sets: which of their columns a policy reads, as its cameras, its state and its actions.

A family's checkpoint says what a policy needs, a data set what it has, and the user what neither tells. Imports nothing
heavy: mistakes are reported before a model is loaded.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from vla_attention.schemas.errors import BadArgument, did_you_mean, listing, unknown_name
from vla_attention.schemas.jsonable import Document

#: What stands for "no column" on the command line.
NONE = "none"
#: LeRobot's beginning of the names of pictures.
IMAGES = "observation.images."
#: Columns that are a robot's state, and its actions, where nobody says otherwise; the first whose all are there.
STATE_COLUMNS = (("observation.state",), ("state",), ("joint_position", "gripper_position"))
ACTION_COLUMNS = (("action",), ("actions",))


def read_camera_choices(words: Sequence[str], existing: Iterable[str]) -> dict[str, str]:
    """Return policy camera -> picture (or `none`) of the words of `--camera`. existing: pictures, for the error.

    Raises:
        BadArgument: a word is not POLICY=PICTURE, or a camera of the policy is named twice.
    """
    chosen: dict[str, str] = {}
    for word in words:
        camera, sign, picture = word.partition("=")
        if not (camera and sign and picture):
            raise BadArgument(
                f"Cannot use --camera {word}; expected POLICY=PICTURE, with a picture of {listing(existing)} or {NONE}."
            )
        if camera in chosen:
            raise BadArgument(f"--camera names the policy's camera '{camera}' twice.")
        chosen[camera] = picture
    return chosen


class Robot(Document, frozen=True):
    """What a policy reads of a robot.

    cameras: policy camera -> column of pictures; the policy's other cameras are black and masked. state, actions:
    columns of numbers, joined in this order; no column of actions: recorded ones are not compared. relative_actions: so
    many first numbers of the policy's actions are differences to the state. turned: the pictures come as simulators
    give them, and the policy turns them by 180 degrees.
    """

    cameras: dict[str, str]
    state: tuple[str, ...]
    state_dim: int
    actions: tuple[str, ...]
    action_dim: int
    relative_actions: int = 0
    turned: bool = False


@dataclass(frozen=True)
class RobotData:
    """What a data set offers and what the user chose.

    name: of the data set, for messages. cameras: its columns of pictures. numbers: column -> numbers in each frame.
    chosen_cameras: policy camera -> column, or `none`. chosen_state, chosen_actions: columns, empty for the usual ones;
    `none` alone for no actions. relative_actions: see `Robot`; None: as the policy's configuration says.
    """

    name: str
    cameras: tuple[str, ...]
    numbers: Mapping[str, int]
    chosen_cameras: Mapping[str, str] = field(default_factory=dict)
    chosen_state: tuple[str, ...] = ()
    chosen_actions: tuple[str, ...] = ()
    relative_actions: int | None = None

    def camera_column(self, name: str) -> str:
        """Return the column of pictures of that name, also without LeRobot's beginning; or raise `UnknownName`."""
        for column in (name, IMAGES + name):
            if column in self.cameras:
                return column
        raise unknown_name(f"camera of the data set '{self.name}'", name, self.cameras)

    def match_cameras(
        self, policy_cameras: Sequence[str], usual: Mapping[str, Iterable[str]], optional: Iterable[str]
    ) -> dict[str, str]:
        """Return policy camera -> column, in the policy's order.

        Args:
            policy_cameras: the policy's cameras.
            usual: the columns that each of them is known by, the first that exists is taken.
            optional: cameras that may stay black and masked without a word.

        Raises:
            UnknownName: a chosen name does not exist.
            BadArgument: a camera has no column, or none is left.
        """
        short = {camera: camera.removeprefix(IMAGES) for camera in policy_cameras}
        for given in self.chosen_cameras:
            if given not in short and given not in short.values():
                raise unknown_name("camera of the policy", given, short.values())
        chosen = {name: self.chosen_cameras.get(name, self.chosen_cameras.get(short[name])) for name in policy_cameras}
        columns: dict[str, str] = {}
        for camera in policy_cameras:
            column = chosen[camera]
            if column is None:
                same = (camera, IMAGES + camera)
                known = [name for name in (*same, *usual.get(camera, ())) if name in self.cameras]
                column = known[0] if known else NONE if camera in set(optional) else None
            if column is None:
                raise BadArgument(
                    f"The policy's camera '{short[camera]}' has no pictures in the data set '{self.name}', whose "
                    f"cameras are {listing(self.cameras)}; give --camera {short[camera]}=NAME, or --camera "
                    f"{short[camera]}={NONE} to leave it black and masked."
                )
            if column != NONE:
                columns[camera] = self.camera_column(column)
        if not columns:
            raise BadArgument(
                f"None of the policy's cameras {listing(short.values())} has pictures in the data set '{self.name}', "
                f"whose cameras are {listing(self.cameras)}; give --camera POLICY=DATASET."
            )
        return columns

    def state_columns(self) -> tuple[str, ...]:
        """Return the columns that make up the state."""
        return self._columns("--state", "state", self.chosen_state, STATE_COLUMNS)

    def action_columns(self) -> tuple[str, ...]:
        """Return the columns of recorded actions; none if the user does not want them."""
        if self.chosen_actions == (NONE,):
            return ()
        return self._columns("--action", "actions", self.chosen_actions, ACTION_COLUMNS)

    def size(self, columns: Iterable[str]) -> int:
        """Return how many numbers columns have together."""
        return sum(self.numbers[column] for column in columns)

    def check_size(self, what: str, option: str, columns: Sequence[str], needed: int) -> None:
        """Raise `BadArgument` unless columns have as many numbers as the policy needs."""
        size = self.size(columns)
        if size != needed:
            stated = listing(f"{column} ({self.numbers[column]})" for column in columns)
            raise BadArgument(
                f"The policy's {what} have {needed} numbers, and those of the data set '{self.name}' {size}: {stated}; "
                f"give {option} COLUMN ... of {listing(f'{name} ({size})' for name, size in self.numbers.items())}."
            )

    def _columns(
        self, option: str, what: str, chosen: tuple[str, ...], usual: Iterable[tuple[str, ...]]
    ) -> tuple[str, ...]:
        for column in chosen:
            if column not in self.numbers:
                raise BadArgument(
                    f"The data set '{self.name}' has no numbers '{column}'.{did_you_mean(column, self.numbers)} "
                    f"Existing: {listing(self.numbers)}."
                )
        if chosen:
            return chosen
        for columns in usual:
            if all(column in self.numbers for column in columns):
                return columns
        raise BadArgument(
            f"Which numbers of the data set '{self.name}' are the {what} is not known; give {option} COLUMN ... of "
            f"{listing(self.numbers)}."
        )
