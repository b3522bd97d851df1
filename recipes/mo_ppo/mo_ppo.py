"""MO-PPO: polish a preference-conditioned policy on its own episodes, all preferences at once.

PPO (https://arxiv.org/abs/1707.06347) whose critic has one value per objective; the advantages are
weighed by the preference of their episode. Run it with ``python -m recipes.mo_ppo.mo_ppo
policy=FOLDER``; every field of ``config.yaml`` can be overridden on the command line.

It follows PD-MORL: critics of TD3 cannot tell actions apart that differ by hundredths of a percent,
which PPO can by averaging over thousands of episodes.
"""

from __future__ import annotations

import copy

import hydra
import torch
import tqdm
from omegaconf import DictConfig
from torchrl._utils import timeit
from torchrl.checkpoint import Checkpoint, CheckpointRotation
from torchrl.collectors import Collector
from torchrl.envs import RewardScaling

from recipes.pd_morl import evaluation, files
from recipes.pd_morl.learning import step, use_bfloat16
from recipes.pd_morl.utils import crossed, log_metrics, make_loggers
from recipes.task import make_averaged, make_task
from torchrl_morl.deploy import load_policy

from . import penalties, utils


@hydra.main(version_base="1.3", config_path="", config_name="config")
def main(cfg: DictConfig) -> None:
    """Polish a policy, evaluate it on the way, and save what is evaluated."""
    start, preference_space, card = load_policy(cfg.policy, device=cfg.device)
    cfg = utils.complete(cfg, card)
    utils.check(cfg)
    task = make_task(cfg)
    utils.check_start(cfg, task, start, preference_space)

    # The policy is noise around the actor; the noise is all that PPO adds to it.
    actor = copy.deepcopy(start).requires_grad_(True)
    sigma = torch.tensor(list(cfg.collector.exploration_sigma), device=task.device)
    noisy, policy = utils.make_policy(actor, sigma)
    critic = utils.make_critic(cfg, task)
    advantage = utils.make_advantage(cfg, task, critic)
    loss = utils.make_loss(cfg, noisy, critic)
    averaged = make_averaged(cfg, actor)
    optimizers = utils.make_optimizers(cfg, loss)
    replay_buffer = utils.make_replay_buffer(cfg, task)
    state = Checkpoint(loss=loss, averaged=averaged, **optimizers)
    frames, begin = utils.resume(cfg, state)
    schedule = utils.make_schedule(cfg, optimizers["actor"], frames, begin)
    # In the card of a policy stands what it was trained in.
    cfg.compute.bfloat16 = use_bfloat16(cfg.compute.bfloat16, task.device)
    precision = torch.autocast(task.device.type, torch.bfloat16, enabled=cfg.compute.bfloat16)
    env = task.env.append_transform(RewardScaling(0.0, cfg.replay_buffer.reward_scale))
    demo = (
        task.preference_space.tunable.index("demo")
        if "demo" in task.preference_space.tunable
        else None
    )
    # Nothing is written before the configuration has been accepted.
    files.write_run_info(task.run_dir)
    loggers = make_loggers(cfg, task.run_dir)

    collector = Collector(
        env,
        policy,
        frames_per_batch=cfg.collector.frames_per_batch,
        total_frames=cfg.collector.total_frames - frames,
        policy_device=task.device,
        storing_device=task.device,
        auto_register_policy_transforms=False,
    )
    checkpoints = CheckpointRotation(
        task.run_dir / "checkpoints", keep_last=1, keep_best=("score", "max")
    )

    progress = tqdm.tqdm(
        total=cfg.collector.total_frames, initial=frames, unit="step", smoothing=0.05
    )
    for batches, data in enumerate(collector, start=frames // cfg.collector.frames_per_batch):
        collected, frames = frames, frames + data.numel()
        progress.update(data.numel())
        # The critic starts from nothing: the actor waits until it has learned the values.
        trains_actor = batches >= cfg.optim.critic_batches
        advantage.lmbda.fill_(cfg.loss.lmbda if trains_actor else 1.0)
        # Advantages of every objective, weighed by the preference of the episode.
        with timeit("advantage"):
            advantage(data)
            parts = data.select(*start.in_keys).split(utils.ENVS_AT_ONCE)
            data["start_action"] = penalties.average_over_time(
                torch.cat([start(part)["action"] for part in parts]),
                data["collector", "traj_ids"],
                window=cfg.loss.anchor_window,
            )
            data["fails"] = utils.failing(data)
        replay_buffer.empty()
        replay_buffer.extend(data.reshape(-1).select(*utils.BATCH))

        metrics = {}
        for _ in range(cfg.optim.epochs if trains_actor else cfg.optim.critic_epochs):
            for batch in replay_buffer:
                with timeit("update"):
                    with precision:
                        losses = loss(batch)
                    step(optimizers["critic"], losses["loss_critic"], cfg.optim.max_grad_norm)
                    if trains_actor:
                        # Penalties are smooth: a part of the batch, which is shuffled, will do.
                        part = batch[: cfg.optim.penalty_batch_size]
                        with precision:
                            costs = penalties.compute(cfg, part, actor, sigma=sigma, demo=demo)
                        loss_actor = losses["loss_objective"]
                        for name, cost in costs.items():
                            loss_actor = loss_actor + cfg.loss[f"{name}_coeff"] * cost
                        step(optimizers["actor"], loss_actor, cfg.optim.max_grad_norm)
                        averaged.update_parameters(actor)
                        metrics |= costs
                metrics |= losses
        if trains_actor:
            schedule.step()
        metrics["failed"] = utils.failure_rate(data)
        logged = {f"train/{name}": value.detach().mean() for name, value in metrics.items()}
        log_metrics(loggers, logged, frames)

        last = frames >= cfg.collector.total_frames
        if last or crossed(cfg.evaluation.interval, collected, frames):
            with timeit("evaluate"):
                result = evaluation.evaluate(
                    cfg, task.eval_env, averaged.module, task.preference_space, task.demonstration
                )
            log_metrics(loggers, result.metrics, frames)
            # What goes on from the end has a schedule of its own.
            next_begin = frames if last else begin
            metadata = {"score": result.score, "frames": frames, "schedule": next_begin}
            checkpoints.save(state, step=frames, metadata=metadata)
            utils.save(task, cfg, frames, averaged.module, result, card)
            tqdm.tqdm.write(result.table(frames))
            progress.set_postfix(success=f"{result.success:.0f}%", score=f"{result.score:.2f}")
    progress.close()
    collector.shutdown()
    timeit.print()
    files.finish(task.run_dir, cfg)


if __name__ == "__main__":
    main()
