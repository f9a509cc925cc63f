"""What `va.record` costs in calls of policies that have an adapter: random models of the real classes.

Usage: python benchmarks/adapter_overhead.py [--policy NAME ...] [--rounds 11] [--clock processor]

Run it in each of the two environments that `make test-policies` makes; the policies that it has are measured.
A call makes ten denoise steps where the policy has any. Three kinds of calls take turns within one round: as they are;
recorded with all layers and heads of the last denoise step, without contributions; and recorded as `va.record` does if
it is not told otherwise (first and last denoise step, with contributions). What is printed are the medians of the
rounds, and of the ratios to the plain call of the same round. Pictures of the cameras are not stored. The actions of
all calls are compared with the plain call's, and must be bit-equal.
"""

from __future__ import annotations

import argparse
import functools
import sys
import tempfile
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

import recorder_overhead as recorder  # noqa: E402 - a script, and not part of the package

import vla_attention as va  # noqa: E402

KINDS: dict[str, dict[str, Any]] = {
    "last step": {"denoise_steps": ["last"], "contributions": False},
    "default": {},
}
#: A policy, its layout and a function that makes one call.
Case = tuple[Any, va.PolicyLayout, Callable[[], torch.Tensor]]


def pi0(width: int, blocks: int) -> Case:
    from tests.policies import pi0_model as models

    policy = models.small_pi0(
        sizes={"num_hidden_layers": blocks, "num_attention_heads": 8, "head_dim": width // 4},
        text_sizes={"hidden_size": width, "intermediate_size": 2 * width},
        expert_sizes={"hidden_size": width, "intermediate_size": 4 * width},
        picture=112,
        chunk=50,
        steps=10,
    )
    given = models.inputs(picture=112, chunk=50)
    layout = va.layouts.pi0_transformers(policy, cameras=models.CAMERAS, prompt_tokens=models.LONGEST)
    return policy, layout, lambda: policy.sample_actions(**given)


def smolvla(width: int, blocks: int) -> Case:
    from tests.policies import lerobot_models as models

    text = {"hidden_size": width, "intermediate_size": 3 * width, "num_hidden_layers": blocks, "head_dim": width // 12}
    with tempfile.TemporaryDirectory() as folder:
        policy = models.small_smolvla(
            Path(folder),
            {**text, "num_attention_heads": 12, "num_key_value_heads": 4},
            {"hidden_size": 96, "intermediate_size": 192, "image_size": 128},
            **{"chunk_size": 50, "n_action_steps": 50, "num_steps": 10, "num_vlm_layers": blocks},
            resize_imgs_with_padding=(128, 128),
        )
    return policy, va.layouts.smolvla(policy), call_of(policy, models.observation(128, 128))


def xvla(width: int, blocks: int) -> Case:
    from tests.policies import lerobot_models as models

    policy = models.small_xvla(
        **models.features(224, 224),
        **{"chunk_size": 30, "n_action_steps": 30, "num_denoising_steps": 10, "hidden_size": width, "depth": blocks},
        **{"num_heads": width // 64, "len_soft_prompts": 32, "max_len_seq": 512, "tokenizer_max_length": 6},
    )
    return policy, va.layouts.xvla(policy), call_of(policy, models.observation(224, 224))


def act(width: int, blocks: int) -> Case:
    from tests.policies import lerobot_models as models

    policy = models.small_act(
        **models.features(480, 640),
        **{"chunk_size": 100, "n_action_steps": 100, "dim_model": width, "n_heads": 8, "dim_feedforward": 4 * width},
        **{"n_encoder_layers": 1, "n_decoder_layers": blocks},
    )
    return policy, va.layouts.act(policy), call_of(policy, models.observation(480, 640))


def gr00t(width: int, blocks: int) -> Case:
    from tests.policies import lerobot_models as models

    policy = models.small_groot(
        {"num_layers": blocks, "num_attention_heads": width // 48, "attention_head_dim": 48, "output_dim": 256},
        **{"head_sizes": {"input_embedding_dim": width, "hidden_size": 256, "action_horizon": 16}, "backbone": 256},
    )
    policy._groot_model.action_head.num_inference_timesteps = 10
    given = models.groot_observation(patches=64)
    layout = va.layouts.gr00t(policy, given["eagle_input_ids"][0], cameras=models.CAMERAS, picture_size=16)
    return policy, layout, call_of(policy, given)


def pi0_fast(width: int, blocks: int) -> Case:
    from tests.policies import lerobot_models as models
    from tests.policies.lerobot_pi_models import small_pi0_fast

    policy = small_pi0_fast(
        {"width": width, "depth": blocks, "mlp_dim": 4 * width, "num_heads": 8, "head_dim": width // 8},
        112,
        **{"n_action_steps": 10, "chunk_size": 10, "max_decoding_steps": 20},
    )
    return policy, va.layouts.pi0_fast(policy), call_of(policy, models.observation(112, 112))


def call_of(policy: Any, given: Any) -> Callable[[], torch.Tensor]:
    from tests.policies import lerobot_models as models

    return functools.partial(models.chunk_of(policy), given)


#: By policy: how it is built, and width and number of the blocks that are recorded.
POLICIES = {
    "pi0 (transformers 5)": (pi0, ((256, 18), (1024, 4))),
    "SmolVLA": (smolvla, ((240, 16), (960, 4))),
    "X-VLA": (xvla, ((256, 12), (1024, 4))),
    "ACT": (act, ((512, 1), (512, 7))),
    "GR00T N1.5": (gr00t, ((384, 16), (1536, 4))),
    "pi0-FAST": (pi0_fast, ((256, 18), (1024, 4))),
}


def main() -> None:
    """Measure the policies of this environment."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", nargs="+", choices=list(POLICIES), default=list(POLICIES))
    parser.add_argument("--rounds", type=int, default=11)
    parser.add_argument("--calls", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--clock", choices=("wall", "processor"), default="wall")
    arguments = parser.parse_args()
    lerobot = find_spec("lerobot") is not None
    if lerobot:
        from tests.policies import stand_in_torchvision

        stand_in_torchvision.install()
    torch.set_num_threads(arguments.threads)
    torch.backends.mha.set_fastpath_enabled(False)
    clock = time.perf_counter if arguments.clock == "wall" else time.process_time
    print(f"torch {torch.__version__}, cpu, float32, {arguments.threads} threads, {arguments.clock} time")
    print("| policy | width x blocks | keys | ms | " + " | ".join(f"{kind}, ms | times" for kind in KINDS) + " |")
    print("|---" * (4 + 2 * len(KINDS)) + "|")
    for name in arguments.policy:
        build, sizes = POLICIES[name]
        if (build is pi0) == lerobot:
            continue
        for width, blocks in sizes:
            policy, layout, call = build(width, blocks)
            with torch.inference_mode(), tempfile.TemporaryDirectory() as folder:
                seconds = recorder.measure(
                    policy, layout, call, KINDS, Path(folder), arguments.rounds, arguments.calls, clock
                )
            plain = seconds["plain"]
            keys = ", ".join(f"{site.keys.num_keys}" for site in layout.sites)
            cells = [name, f"{width} x {blocks}", keys, recorder.milliseconds(plain)]
            for kind in KINDS:
                cells += [recorder.milliseconds(seconds[kind]), recorder.times(seconds[kind], plain)]
            print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
