"""Stage two: answers from stored rows, without the model. One folder per question; never imports torch or mujoco."""
