"""PD-MORL: one TD3 agent with vector values, trained over all preferences at once.

Method of Basaklar et al. (https://arxiv.org/abs/2208.07914) as used by de Heuvel et al.
(https://arxiv.org/abs/2404.04857). Run it with ``python -m recipes.pd_morl.pd_morl``; every field of
``config.yaml`` can be overridden on the command line.
"""

from __future__ import annotations

from pathlib import Path

import hydra
import torch
import tqdm
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchrl._utils import timeit
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from torchrl.collectors import Collector
from torchrl.objectives import SoftUpdate

from . import evaluation, files, learning, utils


@hydra.main(version_base="1.3", config_path="", config_name="config")
def main(cfg: DictConfig) -> None:
    """Train, evaluate while training, and save the last and the best policy."""
    torch.set_num_threads(cfg.compute.torch_threads)
    torch.manual_seed(cfg.seed)
    device = torch.device(cfg.device)
    # In the card of a policy stands what it was trained in.
    cfg.compute.bfloat16 = learning.use_bfloat16(cfg.compute.bfloat16, device)
    run_dir = Path(HydraConfig.get().runtime.output_dir)
    files.check_run_dir(run_dir)

    # The agent: an actor and twin critics that read the preference, one value per objective.
    demo = utils.load_demonstration_objective(cfg)
    reward_model, demo_card = demo if demo else (None, None)
    preference_space = utils.make_preference_space(with_demonstrations=demo is not None)
    env = utils.make_train_env(cfg, preference_space, reward_model)
    eval_env = utils.make_eval_env(cfg, preference_space, reward_model)
    actor, policy = utils.make_policy(cfg, env, preference_space, device)
    loss = utils.make_loss(cfg, env, preference_space, actor, device)
    critic_gradients, actor_gradients = learning.make_gradients(cfg, loss)
    target_updater = SoftUpdate(loss, eps=cfg.optim.polyak)
    averaged = AveragedModel(
        actor, multi_avg_fn=get_ema_multi_avg_fn(cfg.optim.actor_average), use_buffers=False
    )
    optimizers, schedulers = learning.make_optimizers(cfg, loss)
    updates_per_batch = cfg.optim.updates_per_batch
    replay_buffer = utils.make_replay_buffer(
        cfg, preference_space, device, batches=updates_per_batch
    )
    demonstration = evaluation.demonstrated(cfg, demo_card) if demo else None
    if demo and cfg.demonstrations.dataset:
        utils.prefill(cfg, replay_buffer, preference_space, reward_model)
    # Nothing is written before the configuration has been accepted.
    files.write_run_info(run_dir)
    loggers = utils.make_loggers(cfg, run_dir)

    collector = Collector(
        env,
        policy,
        frames_per_batch=cfg.collector.frames_per_batch,
        total_frames=cfg.collector.total_frames,
        init_random_frames=cfg.collector.init_random_frames,
        policy_device=device,
        storing_device=device,
        auto_register_policy_transforms=False,
    )
    checkpoints = CheckpointRotation(
        run_dir / "checkpoints", keep_last=1, keep_best=("score", "max")
    )
    state = Checkpoint(loss=loss, averaged=averaged, **optimizers, **schedulers)

    frames = updates = 0
    score = success = float("nan")
    progress = tqdm.tqdm(total=cfg.collector.total_frames, unit="step", smoothing=0.05)
    for data in collector:
        # Collected by groups of environments, each with preferences of its own segment.
        with timeit("extend"):
            replay_buffer.extend(data.reshape(-1).select(*utils.TRANSITION))
        collected, frames = frames, frames + data.numel()
        policy[-1].step(data.numel())
        progress.update(data.numel())

        metrics = {}
        if frames > cfg.collector.init_random_frames:
            # Sampling replaces the preference of most transitions (hindsight); for all updates at
            # once it costs hardly more than for one.
            with timeit("sample"):
                sample = replay_buffer.sample()
            for batch in sample.split(cfg.replay_buffer.batch_size):
                if cfg.compute.compile:
                    # CUDA graphs may overwrite what those of the last update gave.
                    torch.compiler.cudagraph_mark_step_begin()
                with timeit("update critic"):
                    metrics |= critic_gradients(batch)
                    optimizers["critic"].step()
                updates += 1
                if updates % cfg.optim.policy_delay == 0:
                    with timeit("update actor"):
                        metrics |= actor_gradients(batch)
                        optimizers["actor"].step()
                        target_updater.step()
                        averaged.update_parameters(actor)
            for scheduler in schedulers.values():
                scheduler.step()
            loss.pre_tanh_coeff = utils.pre_tanh_coeff(cfg, frames)

        if metrics and utils.crossed(cfg.logger.interval, collected, frames):
            utils.log_training(loggers, metrics, preference_space, frames, updates)
            progress.set_postfix(utils.progress_line(progress, updates, success, score))

        last = frames >= cfg.collector.total_frames
        if updates and (last or utils.crossed(cfg.evaluation.interval, collected, frames)):
            # Corner preferences: their returns are the key solutions of the interpolator.
            with timeit("evaluate"):
                result = evaluation.evaluate(
                    cfg, eval_env, averaged.module, preference_space, demonstration
                )
            loss.interpolator.refit(result.key_solutions, cfg.evaluation.refit_momentum)
            score, success = result.score, result.success
            utils.log_metrics(loggers, result.metrics, frames)
            checkpoints.save(state, step=frames, metadata={"score": score})
            files.save_training_policy(
                run_dir / "policies" / f"{frames:09d}",
                cfg,
                averaged.module,
                preference_space,
                result,
                demo_card,
            )
            tqdm.tqdm.write(result.table(frames))
    progress.close()
    collector.shutdown()
    timeit.print()
    files.finish(run_dir, cfg)


if __name__ == "__main__":
    main()
