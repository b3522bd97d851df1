"""The tests that every transform has to answer, after the list that TorchRL keeps for its own."""

from __future__ import annotations

import abc
from functools import partial

import pytest
from torchrl.envs import EnvBase, ParallelEnv, SerialEnv, Transform, TransformedEnv
from torchrl.envs.utils import check_env_specs

from torchrl_morl.preferences import PreferenceSpace
from torchrl_morl.testing import VectorRewardMockEnv

SPACE = PreferenceSpace(("core", "distance", "efficiency"), static={"core": 1.0})


def make_env(**kwargs) -> VectorRewardMockEnv:
    return VectorRewardMockEnv(3, polar=True, num_rays=12, **kwargs)


def parallel(make, num_workers: int = 2) -> ParallelEnv:
    return ParallelEnv(num_workers, make, mp_start_method="fork")


class TransformTests(abc.ABC):
    """Environment checks are given; what a transform computes is for the subclass to test."""

    # Set by transforms that are for replay buffers only: environments must refuse them.
    refusal: str | None = None

    @abc.abstractmethod
    def make_transform(self) -> Transform: ...

    def _make_transformed(self) -> TransformedEnv:
        return TransformedEnv(make_env(), self.make_transform())

    def _check(self, make) -> None:
        env: EnvBase | None = None
        try:
            if self.refusal is not None:
                with pytest.raises(RuntimeError, match=self.refusal):
                    env = make()
                    check_env_specs(env)
            else:
                env = make()
                check_env_specs(env)
        finally:
            if env is not None and not env.is_closed:
                env.close()

    def test_single_trans_env_check(self):
        self._check(self._make_transformed)

    def test_serial_trans_env_check(self):
        self._check(lambda: SerialEnv(2, self._make_transformed))

    def test_parallel_trans_env_check(self):
        self._check(partial(parallel, self._make_transformed))

    def test_trans_serial_env_check(self):
        self._check(lambda: TransformedEnv(SerialEnv(2, make_env), self.make_transform()))

    def test_trans_parallel_env_check(self):
        self._check(lambda: TransformedEnv(parallel(make_env), self.make_transform()))

    @abc.abstractmethod
    def test_transform_no_env(self): ...

    @abc.abstractmethod
    def test_transform_compose(self): ...

    @abc.abstractmethod
    def test_transform_env(self): ...

    @abc.abstractmethod
    def test_transform_model(self): ...

    @abc.abstractmethod
    def test_transform_rb(self): ...

    @abc.abstractmethod
    def test_transform_inverse(self): ...
