"""Brax-style environments: `reset(key) -> State`, `step(state, action) -> State`.

Everything that an episode changes lives in `State.pipeline_state`, so that Brax's
auto-reset rebuilds it. Each environment has its `scene`, and a method `world` that
finds the World in a pipeline state, for rendering. `VmapWrapper` stands in for Brax's
where a batch is large.
"""

from blastjax.envs.breach import Breach, Config
from blastjax.envs.vmap import VmapWrapper

__all__ = ["Breach", "Config", "VmapWrapper"]
