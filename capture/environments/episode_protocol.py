"""The numbers of the published LIBERO evaluations of pi0, pi0.5 and Cosmos Policy that are the same in every suite.

Source: `examples/libero/main.py` of openpi and `run_libero_eval.py` of Cosmos Policy. Two further numbers are
elsewhere: the largest number of policy steps depends on the suite (`suites.py`), and the number of actions between two
policy calls on the policy.
"""

from __future__ import annotations

#: Steps of an episode before the first policy call. The simulator drops objects onto the table, and they must come to
#: rest.
WAIT_STEPS = 10
#: The action of a waiting step: no motion, gripper open.
WAIT_ACTION = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0)
#: Numbers of an action: six pose deltas of the gripper and its opening.
ACTION_SIZE = 7
#: Control steps per simulated second.
CONTROL_FREQUENCY_HZ = 20
#: Height and width of a camera picture in pixels.
IMAGE_SIZE = 256
#: The two cameras, by their names in robosuite: one beside the table, one on the hand.
CAMERAS = ("agentview", "robot0_eye_in_hand")
