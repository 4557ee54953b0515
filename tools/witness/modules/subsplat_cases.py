"""Cases of SubSplat's modules. `notes` holds the configuration in the crate's JSON."""

from .subsplat_attention import Attention
from .subsplat_embed import embed
from .subsplat_precise import Precise
from .subsplat_scene import AGG, EMBED, SPGR, Scene
from .subsplat_spgr import Spgr, head

E = 16
# Channels and size (h, w) of the maps of the cases.
MAPS = {"trans4": (16, 4, 6), "cnn2": (10, 7, 9), "cnn4": (16, 5, 5)}


def embed_case(keys):
    def case(c):
        scene = Scene(c, 2, 5, 4)
        c.notes["embed"] = {**keys, "dim": E}
        sh = c.random_input("sh", (2 * scene.per_view, 75), -0.6, 0.6)
        z_g, z_a = embed(c.g, c.notes["embed"], scene.views, scene.parents, sh, scene.per_view)
        c.output("z_g", z_g)
        c.output("z_a", z_a)
    return case


def agg_case(keys, views=2, contrast=1.7):
    def case(c):
        scene = Scene(c, views, 6, 4, lost=("outside", "behind"))
        c.notes["agg"] = keys
        n = views * scene.per_view
        maps = {level: c.random_input(f"map.{level}", (views, *MAPS[level]), -2.0, 2.0) for level in keys["levels"]}
        z = [c.random_input(name, (n, E), -contrast, contrast) for name in ("z_g", "z_a")]
        attention = Attention(c.g, keys, E, maps, scene.views, scene.parents, scene.per_view)
        f_g, f_a = attention.forward(*z)
        c.output("f_g", f_g)
        c.output("f_a", f_a)
    return case


def head_case(form, side, channels):
    def case(c):
        c.g = Precise(c.name)
        keys = {**SPGR["paper"], "head": form, "hidden": 12}
        c.notes = {"spgr": keys, "side": side, "dim": E, "lanes": channels}
        c.output("record", head(c.g, keys, c.random_input("x", (10, E), -1.7, 1.7), "subsplat.geo", side, channels))
    return case


def spgr_case(keys, side, lowpass=[0.3, 0.3]):
    def case(c):
        scene = Scene(c, 2, 4, 3 if side == 2 else 2, lost=("outside",))
        c.notes |= {"spgr": keys, "side": side, "lowpass": lowpass}
        n = 2 * scene.per_view
        record = c.random_input("record", (n, side * side, 11), -1.2, 1.2)
        spgr = Spgr(c.g, keys, side, scene.views, scene.near, scene.parents, scene.per_view, lowpass)
        for name, value in spgr.forward(record).items():
            c.output(name, value)
    return case


P, T = AGG["paper"], AGG["tuned"]
ONE = {"stages_geo": 1, "stages_app": 1}
LINEAR = {"op": "linear", "points": "pixelgaussian"}
AGGREGATIONS = {
    "paper": P,
    "tuned": T,
    "linear": P | ONE | LINEAR | {"groups": 4, "gate": "off"},
    "linear_two": T | ONE | LINEAR | {"n_fixed": 3, "n_learned": 2, "kv_proj": False},
    "linear_clamp": P | ONE | LINEAR | {"mask": "pg_clamp", "gate": "softmax", "n_fixed": 0},
    "clamp": T | ONE | {"mask": "pg_clamp", "occlusion_gate": False},
    "clamp_hidden": P | ONE | {"mask": "pg_clamp", "occlusion_gate": True, "gate": "query"},
    "offsets": T | ONE | {"points": "map_offsets", "n_learned": 3, "gate": "query"},
    "offsets_linear": P | ONE | {"op": "linear", "points": "map_offsets", "n_learned": 2, "groups": 2},
    "groups": P | ONE | {"levels": ["cnn2", "trans4"], "groups": 4, "gate": "softmax"},
    "integer": P | ONE | {"levels": ["cnn4", "trans4", "cnn2"], "sample_convention": "integer", "gate": "off"},
    "bare_maps": P | ONE | {"levels": ["cnn2"], "kv_proj": False, "logit_scale": "one"},
    "cat": P | {"stages_geo": 2, "stages_app": 1, "residual": "cat", "share_stage_weights": True},
    "cat_ffn": P | ONE | {"residual": "cat", "ffn": True},
    "none_ffn": P | {"stages_geo": 2, "stages_app": 0, "residual": "none", "ffn": True, "norm": "pre"},
    "add_ffn": P | {"stages_geo": 1, "stages_app": 2, "ffn": True},
    "literal": P | {"levels": ["trans4"], "strict_literal": True},
}

P, T = SPGR["paper"], SPGR["tuned"]
SPGRS = {
    "paper": P,
    "tuned": T,
    # One or two changes of each preset, so that the cases cover every value of every key.
    "transmittance": P | {"opacity": "transmittance", "primary_view": "source", "gain_space": "rgb"},
    "area": P | {"opacity": "area", "offset_bound": 0.7, "depth_dir": "ray"},
    "none": T | {"opacity": "none", "primary_view": "nearest_visible", "depth_dir": "axis"},
    "depth": P | {"opacity": "optical_depth", "area_at": "parent", "gain_space": "rgb", "delta": 0.4},
    "area_parent": T | {"opacity": "area", "area_at": "parent", "a_min": {"input_px": 0.5}},
    "far": P | {"beta_z": 9.0, "depth_dir": "ray", "dlog_clamp": 0.7},
    "near": T | {"beta_z": 1.6, "depth_dir": "axis", "a_min": "off"},
    "disc": P | {"slide": "disc", "a_min": {"target_px": 2.0}},
    "disc_ray": T | {"slide": "disc", "lambda_s": {"over_sqrt_k": 1.2}},
    "two_axis": P | {"a_min": {"target_px": 2.0}, "a_min_mode": "two_axis"},
    "two_axis_depth": T | {"a_min": {"target_px": 2.0}, "a_min_mode": "two_axis", "offset_bound": None},
}
ALSO_16 = ["paper", "tuned", "transmittance", "area", "none", "two_axis_depth"]

CASES = {f"sub_embed_{name}": embed_case(keys) for name, keys in EMBED.items()}
CASES["sub_embed_view0"] = embed_case({**EMBED["tuned"], "mlp": "pg", "anchor_frame": "view0", "scale": "raw"})
CASES["sub_embed_lite_raw"] = embed_case({**EMBED["paper"], "mlp": "lite", "scale": "log_px"})
CASES |= {f"sub_agg_{name}": agg_case(keys) for name, keys in AGGREGATIONS.items()}
CASES["sub_agg_three_views"] = agg_case(AGG["paper"] | ONE | {"op": "linear", "levels": ["cnn2", "trans4"]}, 3)
# Queries so small that the LayerNorm's epsilon affects the result.
CASES["sub_agg_faint"] = agg_case(AGG["tuned"] | ONE | {"residual": "none", "occlusion_gate": False}, 2, 0.005)
CASES |= {f"sub_head_{form}": head_case(form, 2, 9) for form in ("mlp2", "pg", "coord")}
CASES |= {"sub_head_coord_4": head_case("coord", 4, 2), "sub_head_mlp2_3": head_case("mlp2", 3, 2)}
CASES |= {"sub_head_polynomial": head_case("polynomial", 2, 9), "sub_head_polynomial_3": head_case("polynomial", 3, 2)}
CASES |= {f"sub_spgr_{name}": spgr_case(keys, 2) for name, keys in SPGRS.items()}
CASES |= {f"sub_spgr_{name}_16": spgr_case(SPGRS[name], 4) for name in ALSO_16}
CASES["sub_spgr_depth_lowpass"] = spgr_case(SPGR["tuned"], 2, [1.2, 0.3])
