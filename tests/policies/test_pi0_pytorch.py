"""pi0 of LeRobot, whose network is openpi's PyTorch code, and openpi's websocket server with it."""

from __future__ import annotations

import socket
import sys
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("lerobot", reason="run by make test-policies, in .venv-lerobot")

import vla_attention as va
from tests.policies import lerobot_models as models
from tests.policies.lerobot_pi_models import small_pi0_lerobot
from tests.policies.policy_checks import (
    PolicyCase,
    check_analysis,
    check_change,
    check_contributions,
    check_rows,
    check_uniform_attention,
    kept_outputs,
    record,
    roles_of,
    rows_of,
)
from tests.policies.word_tokenizer import INSTRUCTION, WordTokenizer
from vla_attention.schemas.stores.reader import open_store
from vla_attention.schemas.stores.verify import verify_store

PATCHES, CHUNK, PADDING = 16, 5, 3
WORDS = len(INSTRUCTION.split())


@pytest.fixture(scope="module")
def case():
    policy = small_pi0_lerobot()
    given = models.observation(56, 56, padding=PADDING)
    frames, state = models.frames_of(given), given["observation.state"]
    return PolicyCase(policy, va.layouts.pi0_pytorch(policy), models.chunk_of(policy), given, frames, state)


def test_rows_are_the_weights_that_the_expert_s_layers_return(case, tmp_path):
    store = record(case, tmp_path)
    layers = [layer.self_attn for layer in case.policy.model.paligemma_with_expert.gemma_expert.model.layers]
    with kept_outputs(layers, lambda _module, _inputs, output: output[1][0, :, -CHUNK:].detach()) as weights:
        case.call(case.observation)
    check_rows(store, "joint", torch.stack([torch.stack(layer) for layer in weights]).numpy())
    prompt = ["instruction"] * WORDS + ["padding"] * PADDING
    assert roles_of(store, "joint") == [*["image"] * (2 * PATCHES), *prompt, "state", *["action"] * CHUNK]


@pytest.mark.parametrize("camera", models.CAMERAS)
def test_a_camera_s_picture_reaches_its_patches_and_no_others(case, camera):
    name = f"observation.images.{camera}"
    check_change(case, f"camera:{camera}", {**case.observation, name: 1 - case.observation[name]})


def test_the_state_reaches_its_key(case):
    check_change(case, "span:state", {**case.observation, "observation.state": torch.zeros(1, 6)})


def test_contributions_are_what_the_expert_s_layers_add(case, tmp_path):
    layers = case.policy.model.paligemma_with_expert.gemma_expert.model.layers

    def stream(block):
        return (layers[block].input_layernorm, "given"), (layers[block].post_attention_layernorm, "given")

    check_contributions(case, record(case, tmp_path), "joint", stream)


def test_a_knockout_takes_the_keys_mass_away(case, tmp_path):
    rows = rows_of(record(case, tmp_path, replans=1, interventions=va.knockout("word:bowl")), "joint")
    assert not rows[..., 2 * PATCHES + INSTRUCTION.split().index("bowl")].any()
    np.testing.assert_allclose(rows.sum(axis=-1), 1, atol=1e-5)


def test_the_analysis_answers(case, tmp_path):
    record(case, tmp_path)
    check_analysis(tmp_path, ["joint"])


class Served:
    """A policy with openpi's `infer` around LeRobot's pi0."""

    def __init__(self, policy: Any) -> None:
        self.policy = policy

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        batch = models.observation(56, 56, padding=PADDING, instruction=obs["prompt"])
        batch["observation.images.top"] = torch.tensor(obs["picture"]).permute(2, 0, 1)[None] / 255
        return {"actions": models.chunk_of(self.policy)(batch)[0].numpy()}


def test_openpi_s_server_and_client_record_what_a_call_without_them_gives(case, tmp_path, monkeypatch):
    server_module = pytest.importorskip("openpi_server")
    client_module = pytest.importorskip("openpi_client.websocket_client_policy")
    monkeypatch.setattr(sys, "path", [str(Path(__file__).parents[2] / "examples"), *sys.path])
    from openpi_recorded import RecordingPolicy

    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port = listener.getsockname()[1]
    served = Served(case.policy)
    recording = RecordingPolicy(
        served,
        str(tmp_path / "run.zarr"),
        frames=lambda obs: {"top": obs["picture"]},
        tokenizer=WordTokenizer(),
        untrained=True,
        durable=False,
    )
    server = server_module.WebsocketPolicyServer(recording, host="127.0.0.1", port=port)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    for _ in range(600):
        with socket.socket() as asking:
            if asking.connect_ex(("127.0.0.1", port)) == 0:
                break
        time.sleep(0.1)
    client = client_module.WebsocketClientPolicy("127.0.0.1", port)
    picture = np.random.default_rng(0).integers(0, 255, (56, 56, 3), dtype=np.uint8)
    observation = {"prompt": INSTRUCTION, "picture": picture}
    plain = client.infer(observation)["actions"]
    for episode in (0, 1):
        for step in (0, 5):
            place = {"task_id": 2, "episode_index": episode, "env_step": step}
            answer = client.infer({**observation, "episode": place})
            np.testing.assert_array_equal(answer["actions"], plain)
        client.infer({"episode": {"ended": True, "success": episode == 0, "num_steps": 9}})
    # An episode that never ends is not stored.
    client.infer({**observation, "episode": {"task_id": 3, "episode_index": 0, "env_step": 0}})
    store = open_store(tmp_path / "run.zarr")
    assert verify_store(store) == []
    facts = [(part.attributes.task_id, part.attributes.success, part.attributes.num_steps) for part in store.episodes]
    assert facts == [(2, True, 9), (2, False, 9)]
    np.testing.assert_array_equal(store.episodes[0].read("frames/top")[0], picture)
    np.testing.assert_array_equal(store.episodes[1].read("actions")[1], plain.astype(np.float64))


def test_queries_of_zero_have_lift_1(case, tmp_path):
    check_uniform_attention(case, tmp_path)
