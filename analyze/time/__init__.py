"""`vla-attention time`: the course of an episode, the gripper's first closing, success against failure."""
