"""The engine of captures, reruns and replays: sources of policy calls, the calls, the loop over episodes, progress."""
