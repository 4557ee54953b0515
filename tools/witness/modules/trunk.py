"""SubSplat's modules after the backbone: embeddings, attention, heads, reparameterization (SubSplat, section
3.2; supplement A.2, A.3). The case's graph must be a subsplat_precise.Precise, because areas are determinants
here."""

from .subsplat_attention import Attention
from .subsplat_embed import embed
from .subsplat_scene import AGG, EMBED, SPGR, Scene
from .subsplat_spgr import Spgr, heads


def preset(name, **sections):
    """Returns {"embed", "agg", "spgr"} of a preset with the given changes: preset("tuned", spgr={"hidden":
    24})."""
    base = {"embed": EMBED[name], "agg": AGG[name], "spgr": SPGR[name]}
    return {section: {**keys, **sections.get(section, {})} for section, keys in base.items()}


def trunk(g, config, side, views, near, parents, sh, maps, per_view):
    """Returns the children of N = V per_view parents: `steps`, `quats`, `log_scales`, `opacities`, `gain`
    (subsplat_spgr.Spgr).

    config: result of `preset`. views: subsplat_geometry.View per view, pixels of the input. near: [V].
    parents, in view and pixel order, world frame: means [N, 3], quats [N, 4] wxyz with w >= 0, scales [N, 3]
    sigma, opacities [N, 1]. sh: [N, 3 D], colour by colour, in the frame of config["embed"]["sh"] (world:
    after the rotation, camera: before it). maps: {level: [V, C, h, w]} for config["agg"]["levels"]. Weights:
    subsplat.*."""
    z_g, z_a = embed(g, config["embed"], views, parents, sh, per_view)
    inputs = (z_g, z_a)
    if config["agg"]["enabled"]:
        attention = Attention(g, config["agg"], config["embed"]["dim"], maps, views, parents, per_view)
        inputs = attention.head_inputs(z_g, z_a)
    record = heads(g, config["spgr"], *inputs, side)
    return Spgr(g, config["spgr"], side, views, near, parents, per_view).forward(record)


# Channels and size (h, w) of the maps of the cases below.
MAPS = {"trans4": (24, 3, 4), "cnn2": (20, 5, 7)}


def case(config, side):
    def build(c):
        scene = Scene(c, 2, 7, 5)
        c.notes |= {**config, "upscale": side}
        sh = c.random_input("sh", (2 * scene.per_view, 75), -0.6, 0.6)
        maps = {level: c.random_input(f"map.{level}", (2, *MAPS[level]), -2.0, 2.0) for level in config["agg"]["levels"]}
        out = trunk(c.g, config, side, scene.views, scene.near, scene.parents, sh, maps, scene.per_view)
        for name, value in out.items():
            c.output(name, value)
    return build


SMALL = {"embed": {"dim": 24}, "spgr": {"hidden": 20}}
CASES = {
    "sub_trunk_paper": case(preset("paper", **SMALL), 2),
    "sub_trunk_tuned": case(preset("tuned", **SMALL), 2),
    "sub_trunk_no_attention": case(preset("paper", **SMALL, agg={"enabled": False}), 3),
    "sub_trunk_literal": case(preset("tuned", **SMALL, agg={"strict_literal": True}), 1),
}
