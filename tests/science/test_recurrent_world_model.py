"""The recurrent world model on robots whose rules are known."""

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from models.networks.observation import FARTHEST
from models.segments import Observations, SegmentBatch, at, first, future
from models.spaces import BoxAction, DiscreteAction, Spaces, StreamSpec
from models.training import NonFiniteError, TrainingConfig, TrainingState, advance, begin, train
from models.world_models import recurrent
from models.world_models.recurrent import PAPER, RecurrentWorldModel, RecurrentWorldModelConfig
from tests.science import toy_robot

TRAINING = TrainingConfig(steps=300, batch_size=32, learning_rate=1e-2, weight_decay=0.0, clip=100.0)
NUMBERS = {"numbers": StreamSpec((3,), "float32")}


def _model(spaces: Spaces = toy_robot.POINT, seed: int = 0, **fields: object) -> RecurrentWorldModel:
    config = replace(toy_robot.TINY, **fields)  # type: ignore[arg-type]  # fields of the config
    return RecurrentWorldModel(spaces, config, torch.Generator().manual_seed(seed))


def _open_loop_error(model: RecurrentWorldModel, batch: SegmentBatch, step: int) -> tuple[float, float]:
    """Root mean squared error of what is predicted for observation `step`, and of predicting that nothing moves."""
    assert batch.actions is not None
    with torch.inference_mode():
        prediction = model.rollout(model.infer_state(first(batch.observations)), batch.actions)
        guess, truth = model.observe(prediction[:, step - 1]), at(batch.observations, step)
    return _rmse(guess, truth), _rmse(at(batch.observations, 0), truth)


def _rmse(left: Observations, right: Observations) -> float:
    return float(torch.cat([(left[n].float() - right[n].float()).flatten() for n in right]).square().mean().sqrt())


@pytest.fixture(scope="module")
def point() -> RecurrentWorldModel:
    """Trained on 400 segments of the point."""
    model, generator = _model(), torch.Generator().manual_seed(1)
    train(model, toy_robot.points(400, 11, seed=0), TRAINING, generator)
    return model


@pytest.fixture(scope="module")
def unseen() -> SegmentBatch:
    """100 other segments of the point."""
    return toy_robot.points(100, 8, seed=1)


@pytest.mark.parametrize("step", [1, 4, 8])
def test_a_point_is_predicted_open_loop(step: int, point: RecurrentWorldModel, unseen: SegmentBatch) -> None:
    error, standstill = _open_loop_error(point, unseen, step)
    assert error < 0.45 * standstill, (error, standstill)


def test_a_square_is_predicted_open_loop() -> None:
    model = _model(toy_robot.PICTURE)
    train(model, toy_robot.pictures(300, 9, seed=0), replace(TRAINING, batch_size=16), torch.Generator().manual_seed(1))
    error, standstill = _open_loop_error(model, toy_robot.pictures(100, 4, seed=1), 4)
    assert error < 0.7 * standstill, (error, standstill)


def test_the_distance_ranks_segments_as_their_prediction_errors_do(
    point: RecurrentWorldModel, unseen: SegmentBatch
) -> None:
    """Some segments are predicted under actions that were not taken, as far off as chance has it."""
    assert unseen.actions is not None
    draw = torch.Generator().manual_seed(0)
    off = torch.rand(unseen.size, 1, 1, generator=draw) * torch.randn(unseen.actions.shape, generator=draw)
    with torch.inference_mode():
        state = point.infer_state(first(unseen.observations))
        prediction = point.rollout(state, (unseen.actions + off).clamp(-1, 1))
        distance = point.distance(prediction, future(unseen.observations))
        guess = point.observe(prediction.flatten(0, 1))["position"].view(unseen.size, -1, 2)
    error = (guess - unseen.observations["position"][:, 1:]).square().sum((1, 2))
    ranks = torch.stack([each.argsort().argsort().double() for each in (distance, error)])
    assert float(torch.corrcoef(ranks)[0, 1]) > 0.7


def test_all_steps_at_once_are_one_step_after_the_other(point: RecurrentWorldModel, unseen: SegmentBatch) -> None:
    assert unseen.actions is not None
    whole = point.infer_state(unseen.observations, unseen.actions)
    state: Tensor | None = None
    for step in range(unseen.length + 1):
        led = unseen.actions[:, :0] if step == 0 else unseen.actions[:, step - 1 : step]
        frame = {name: stream[:, step : step + 1] for name, stream in unseen.observations.items()}
        state = point.infer_state(frame, led, state)
    assert state is not None
    torch.testing.assert_close(state, whole)


def test_the_encoder_of_all_frames_is_that_of_each() -> None:
    model, batch = _model(toy_robot.PICTURE), toy_robot.pictures(3, 5, seed=0)
    together = model.embed(model.streams.frame(batch.observations))
    for step in range(6):
        alone = model.embed(model.streams.frame({"camera": batch.observations["camera"][:, step : step + 1]}))
        torch.testing.assert_close(alone[:, 0], together[:, step])


def test_more_frames_than_are_read_at_a_time_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    model, batch = _model(toy_robot.PICTURE), toy_robot.pictures(5, 3, seed=0)
    whole = model.infer_state(batch.observations, batch.actions)
    monkeypatch.setattr(recurrent, "FRAMES", 3)
    torch.testing.assert_close(model.infer_state(batch.observations, batch.actions), whole)
    nothing = batch.take(slice(0, 0))
    assert model.infer_state(nothing.observations, nothing.actions).shape == (0, toy_robot.TINY.state)


def test_the_decoded_distance_is_the_logarithm_of_squared_errors_of_numbers(
    point: RecurrentWorldModel, unseen: SegmentBatch
) -> None:
    decoded = _model(distance="decoded", numbers_weight=3.0)
    decoded.load_state_dict(point.state_dict())
    assert unseen.actions is not None
    after = future(unseen.observations)
    with torch.inference_mode():
        prediction = decoded.rollout(decoded.infer_state(first(unseen.observations)), unseen.actions)
        distance = decoded.distance(prediction, after)
        guess = decoded.decode(prediction.flatten(0, 1))["numbers"].view(unseen.size, 8, 2)
        truth = decoded.streams.frame(after).numbers
    assert truth is not None
    torch.testing.assert_close(distance, 3.0 * (1 + (guess - truth).square()).log().sum((1, 2)))
    with pytest.raises(ValueError, match="distance must be one of divergence, decoded, got 'nearness'"):
        _model(distance="nearness")


def test_a_rollout_is_repeated_prediction(point: RecurrentWorldModel, unseen: SegmentBatch) -> None:
    assert unseen.actions is not None
    state = point.encode(at(unseen.observations, 0))
    twice = point.predict(point.predict(state, unseen.actions[:, 0]), unseen.actions[:, 1])
    torch.testing.assert_close(point.rollout(state, unseen.actions)[:, 1], twice)


def test_predictions_of_other_steps_are_refused(point: RecurrentWorldModel, unseen: SegmentBatch) -> None:
    assert unseen.actions is not None
    prediction = point.rollout(point.infer_state(first(unseen.observations)), unseen.actions[:, :3])
    with pytest.raises(ValueError, match=r"predictions \(100, 3\) are of other steps than \(100, 8\)"):
        point.distance(prediction, future(unseen.observations))


def test_what_stands_still_predicts_no_change() -> None:
    still = toy_robot.Standstill(toy_robot.PICTURE, toy_robot.TINY, torch.Generator())
    camera = torch.zeros(1, 2, 16, 16, 3, dtype=torch.uint8)
    camera[0, 1, 3, :5] = 200
    camera[0, 1, 9] = 10  # not to be seen
    correct, changed = still.changes(camera[:, 0], {"camera": camera})
    assert (correct.tolist(), changed.tolist()) == ([0], [15])
    almost = (camera[:, 1].float() * 0.8).byte()
    assert still.changes(almost, {"camera": camera})[0].tolist() == [15]


@torch.inference_mode()
def test_members_that_agree_disagree_by_nothing(point: RecurrentWorldModel, unseen: SegmentBatch) -> None:
    decoded = point.decode(point.encode(at(unseen.observations, 0)))
    other = {name: stream + 0.5 for name, stream in decoded.items()}
    assert float(point.disagreement([decoded, decoded, decoded]).max()) == 0.0
    expected = 2 * 100.0 * 0.25**2  # two coordinates, the weight of numbers, the variance of two members
    torch.testing.assert_close(point.disagreement([decoded, other]), torch.full((unseen.size,), expected))


def test_signatures_tell_which_way_a_segment_goes(point: RecurrentWorldModel) -> None:
    position = torch.tensor([[[0.0, 0.0], [1.5, 0.0]], [[-0.6, 0.3], [0.9, 0.31]], [[0.0, 0.0], [0.0, -1.5]]])
    actions = torch.tensor([[[1.0, 0.1]], [[0.8, -0.2]], [[0.1, -0.9]]])
    signatures = point.signatures({"position": position}, actions)
    assert signatures.tolist() == [[1, 0, 1, 0], [1, 0, 1, 0], [0, -1, 0, -1]]
    assert point.latent_features({"position": position}, actions).shape == (3, toy_robot.TINY.deterministic)


def test_missing_actions_are_counted(point: RecurrentWorldModel, unseen: SegmentBatch) -> None:
    with pytest.raises(ValueError, match="9 observations have 8 actions between them, got none"):
        point.infer_state(unseen.observations)


def test_a_divergence_below_the_free_nats_costs_them_and_teaches_nothing() -> None:
    batch = toy_robot.points(4, 5, seed=0)
    losses, gradients = [], []
    for free in (0.0, 1.0):
        model = _model(free_nats=free)
        with torch.no_grad():  # prior and posterior are uniform, but for a little
            model.recurrence.prior_head.weight.mul_(1e-3)
            model.recurrence.posterior_head.weight.mul_(1e-3)
        loss = model.loss(batch, torch.Generator().manual_seed(0))
        loss.backward()  # type: ignore[no-untyped-call]  # untyped in torch
        losses.append(float(loss.detach()))
        assert model.recurrence.prior_head.weight.grad is not None
        gradients.append(float(model.recurrence.prior_head.weight.grad.abs().max()))
    assert losses[1] - losses[0] == pytest.approx(0.6, abs=1e-4)  # (.5 + .1) of a nat
    assert gradients[0] > 0.0
    assert gradients[1] == 0.0


def test_the_loss_compiles_as_one_graph() -> None:
    model, batch = _model(toy_robot.PICTURE), toy_robot.pictures(4, 5, seed=0)
    before = model.loss(batch, torch.Generator().manual_seed(0))
    model.compile(backend="eager", fullgraph=True)
    after = model.loss(batch, torch.Generator().manual_seed(0))
    torch.testing.assert_close(after, before)
    after.backward()  # type: ignore[no-untyped-call]  # untyped in torch


def test_one_generator_gives_one_result() -> None:
    """And so does training in slices: windows, draws, and moments of numbers go on where they stopped."""
    dataset, config = toy_robot.points(40, 14, seed=0), replace(TRAINING, steps=6)
    weights = []
    for slices in ((6,), (6,), (1, 4, 6)):
        model = _model()
        state = begin(model, config, torch.Generator().manual_seed(3))
        for until in slices:
            model = _model(seed=9)  # another process would not have the weights
            state = TrainingState.from_bytes(advance(model, dataset, state, until).to_bytes())
        weights.append(model.state_dict())
    for other in weights[1:]:
        assert all(torch.equal(other[name], weights[0][name]) for name in other)


def test_a_loss_that_is_no_number_names_its_segments() -> None:
    model = _model()
    with torch.no_grad():
        model.recurrence.cell.norm.bias[0] = torch.nan
    with pytest.raises(NonFiniteError, match=r"loss of world_model is nan at step 0; its segments: robot-0:[01], "):
        train(model, toy_robot.points(2, 4, seed=0), TRAINING, torch.Generator())


def test_an_observation_that_is_no_number_is_named() -> None:
    batch = toy_robot.points(3, 4, seed=0)
    batch.observations["position"][1, 2, 0] = torch.inf
    with pytest.raises(ValueError, match="position of segment robot-0:1 holds a number that is not finite"):
        train(_model(), batch, TRAINING, torch.Generator())


def test_a_batch_without_actions_does_not_train() -> None:
    with pytest.raises(ValueError, match="no actions"):
        _model().loss(toy_robot.points(3, 4, seed=0).without_labels(), torch.Generator())


@pytest.mark.parametrize(
    ("spaces", "message"),
    [
        (Spaces(NUMBERS, DiscreteAction(7)), "bounded box of shape"),
        (Spaces(NUMBERS, BoxAction(-float("inf"), 1.0, (2,))), "bounded box of shape"),
        (Spaces({"joints": StreamSpec((3,), "int64")}, toy_robot.ACTION), "joints must be an image.*got int64"),
        (Spaces({"front": StreamSpec((48, 48, 3), "uint8")}, toy_robot.ACTION), "Images must all be"),
        (Spaces({"depth": StreamSpec((8, 8), "float32")}, toy_robot.ACTION), "depth must be an image"),
        (Spaces({}, toy_robot.ACTION), "at least one observation stream"),
    ],
)
def test_spaces_that_do_not_fit_are_refused(spaces: Spaces, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        _model(spaces)


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="unimix must be between 0 and 1, got 1"):
        RecurrentWorldModelConfig(unimix=1.0)
    with pytest.raises(ValueError, match="window must be at least 2, got 1"):
        RecurrentWorldModelConfig(window=1)


def test_the_paper_s_preset_has_the_stated_sizes() -> None:
    assert (PAPER.deterministic, PAPER.groups, PAPER.classes, PAPER.state) == (512, 32, 32, 1536)
    images = {name: StreamSpec((64, 64, 3), "uint8") for name in ("front", "wrist")}
    spaces = Spaces({**images, "proprioception": StreamSpec((11,), "float32")}, BoxAction(-1.0, 1.0, (7,)))
    assert RecurrentWorldModel(spaces, PAPER, torch.Generator()).encoder.outputs == 5120


def test_numbers_far_from_all_that_training_has_shown_count_ten_deviations() -> None:
    model = RecurrentWorldModel(toy_robot.POINT, toy_robot.TINY, torch.Generator().manual_seed(0))
    model.streams.measure(toy_robot.points(50, 4, seed=1).observations)
    frame = model.streams.frame({"position": torch.tensor([[1e6, -1e6], [0.0, 0.0]])})
    assert frame.numbers is not None
    assert frame.numbers[0].tolist() == [FARTHEST, -FARTHEST]
    assert bool((frame.numbers[1].abs() < 1).all())
