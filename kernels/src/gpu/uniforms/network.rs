//! Uniforms of the kernels of the network.

use super::UniformStruct;

uniform! {
    /// Parameters of wgsl/network/elementwise.wgsl.
    ElementwiseUniform {
        /// Elements of the result.
        count: u32,
        /// Factor of `AFFINE`, lower bound of `CLAMP` and `WITHIN`, bound of `WHERE_ABOVE`.
        first: f32,
        /// Summand of `AFFINE`, upper bound of `CLAMP` and `WITHIN`, other number of `WHERE_ABOVE`.
        second: f32,
        /// Axes in use, the last ones.
        axes: u32,
        /// Sizes of seven axes, outermost first; unused.
        sizes: [[u32; 4]; 2],
        /// Strides of the first array; offset of its first element.
        left: [[u32; 4]; 2],
        /// Those of the second array.
        right: [[u32; 4]; 2],
        /// Those of the result.
        result: [[u32; 4]; 2],
    }
}

uniform! {
    /// Parameters of wgsl/network/convolution.wgsl. Sizes are z, y, x.
    ConvolutionUniform {
        /// Input channels.
        channels: u32,
        /// Output channels.
        outputs: u32,
        /// Terms of a sum: channels times the volume of the kernel.
        terms: u32,
        /// Pixels of a result.
        pixels: u32,
        /// Size of the input; unused.
        input_size: [u32; 4],
        /// Size of the result; unused.
        output_size: [u32; 4],
        /// Size of the kernel; unused.
        kernel: [u32; 4],
        /// Strides; unused.
        stride: [u32; 4],
        /// Zeros on either side; 1 if there is a bias.
        padding: [u32; 4],
    }
}

uniform! {
    /// Parameters of wgsl/network/linear.wgsl.
    LinearUniform {
        /// Rows of x.
        rows: u32,
        /// Columns of y.
        outputs: u32,
        /// Columns of x.
        terms: u32,
        /// 1 if there is a bias.
        has_bias: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/norm_statistics.wgsl, norm_apply.wgsl, norm_sums_bwd.wgsl and
    /// norm_bwd.wgsl.
    NormUniform {
        /// Rows.
        rows: u32,
        /// Numbers of a row.
        length: u32,
        /// Consecutive numbers of one channel.
        run: u32,
        /// Rows of one picture: row r holds the channels (r % groups)·length / run and following.
        groups: u32,
        /// Parts of a row.
        parts: u32,
        /// 1 if channels have factors and summands.
        has_affine: u32,
        /// ε.
        epsilon: f32,
        /// Parts of a channel's numbers in the backward pass, else 0.
        channel_parts: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/layer_norm.wgsl, layer_norm_bwd.wgsl and softmax.wgsl.
    RowsUniform {
        /// Rows.
        rows: u32,
        /// Numbers of a row.
        length: u32,
        /// ε.
        epsilon: f32,
        /// Unused.
        pad: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/resize.wgsl. Sizes are height, width.
    ResizeUniform {
        /// Size of the input.
        input_size: [u32; 2],
        /// Size of the result.
        output_size: [u32; 2],
        /// Planes.
        planes: u32,
        /// Unused.
        pad: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/reduce.wgsl.
    ReduceUniform {
        /// Product of the sizes before the axis.
        outer: u32,
        /// Size of the axis.
        length: u32,
        /// Product of the sizes after it.
        inner: u32,
        /// Factor of the sum: 1, or 1 / length for a mean.
        factor: f32,
    }
}

uniform! {
    /// Parameters of wgsl/network/sum_parts.wgsl.
    SumPartsUniform {
        /// Product of the sizes before the axis.
        outer: u32,
        /// Size of the axis.
        length: u32,
        /// Product of the sizes after it.
        inner: u32,
        /// Sums of the axis.
        parts: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/linear_weight_bwd.wgsl.
    LinearWeightBwdUniform {
        /// Rows.
        rows: u32,
        /// Outputs.
        outputs: u32,
        /// Terms.
        terms: u32,
        /// Rows of a part.
        part: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/select_rows.wgsl and select_rows_bwd.wgsl.
    SelectUniform {
        /// Product of the sizes before the axis.
        outer: u32,
        /// Size of the axis.
        length: u32,
        /// Product of the sizes after it.
        inner: u32,
        /// Number of indices.
        chosen: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/attention.wgsl.
    AttentionUniform {
        /// Rows: windows or heads.
        rows: u32,
        /// Queries of a row.
        queries: u32,
        /// Keys of a row.
        keys: u32,
        /// Width of queries and keys.
        width: u32,
        /// Width of values.
        value_width: u32,
        /// Windows with labels: row r has those of window r % `windows`. 0: no labels.
        windows: u32,
        /// Factor of the dot product.
        scale: f32,
        /// Term of the logits of pairs with different labels.
        penalty: f32,
    }
}

uniform! {
    /// Parameters of wgsl/network/expectation.wgsl.
    ExpectationUniform {
        /// Pictures.
        pictures: u32,
        /// Candidates.
        candidates: u32,
        /// Pixels of a picture.
        pixels: u32,
        /// Half-width of the window, candidates.
        window: u32,
        /// 1: the mean is that of the window.
        window_alone: u32,
        /// Unused.
        pad0: u32,
        /// Unused.
        pad1: u32,
        /// Unused.
        pad2: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/convex.wgsl.
    ConvexUniform {
        /// Pictures.
        pictures: u32,
        /// Height of the coarse map.
        height: u32,
        /// Width of the coarse map.
        width: u32,
        /// Unused.
        pad: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/head_output.wgsl.
    HeadOutputUniform {
        /// Pictures.
        pictures: u32,
        /// Pixels of a picture.
        pixels: u32,
        /// Numbers of a raw row; the next channel is the opacity's.
        raw: u32,
        /// 1: rows contain the colour of their pixel.
        coloured: u32,
        /// Places of red, green and blue in a row; unused.
        places: [u32; 4],
        /// Factor of the colour.
        factor: f32,
        /// Summand of the colour.
        offset: f32,
        /// 1: opacity = sigmoid(confidence + residual)², else sigmoid(residual + 2).
        confident: u32,
        /// Unused.
        pad: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/cross_check.wgsl.
    CrossCheckUniform {
        /// Scenes.
        scenes: u32,
        /// Views of a scene.
        views: u32,
        /// Height, px.
        height: u32,
        /// Width, px.
        width: u32,
        /// Factor of a pixel that is inconsistent everywhere.
        least: f32,
        /// Sum of |difference of colour| from which inconsistency is 1.
        colour: f32,
        /// Share of z by which a hidden point lies behind a surface.
        behind: f32,
        /// Unused.
        pad: f32,
    }
}

uniform! {
    /// Parameters of wgsl/network/depth_consensus.wgsl.
    DepthConsensusUniform {
        /// Scenes.
        scenes: u32,
        /// Views of a scene.
        views: u32,
        /// Height, px.
        height: u32,
        /// Width, px.
        width: u32,
        /// Weight of a pixel's own depth.
        own_weight: f32,
        /// Sum of |difference of colour| at which support falls to 1/e.
        colour: f32,
        /// Number of σ from which a surface gives no support.
        reach: f32,
        /// Term of the weights.
        least_weight: f32,
        /// Distance from a ray up to which a surface point is on it, px per axis.
        on_ray: f32,
        /// Steps of the search for the intersection of a ray and a surface.
        steps: u32,
        /// Unused.
        pad_a: u32,
        /// Unused.
        pad_b: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/raw_matching_blocks.wgsl and raw_matching_scores.wgsl.
    RawMatchingUniform {
        /// Pairs of reference and source.
        rows: u32,
        /// Candidates.
        candidates: u32,
        /// Height at quarter resolution, px.
        height: u32,
        /// Width at quarter resolution, px.
        width: u32,
        /// Smallest z of a source point, as a share of the reference depth.
        z_min: f32,
        /// Term of the variances.
        variance_floor: f32,
        /// Unused.
        pad0: f32,
        /// Unused.
        pad1: f32,
    }
}

uniform! {
    /// Parameters of wgsl/network/attributes.wgsl.
    AttributesUniform {
        /// Rows of R, world from camera, of the frame; its position.
        frame: [[f32; 4]; 3],
        /// Rows of the matrix that turns quaternions into the frame.
        turn: [[f32; 4]; 4],
        /// Rows of R of the source view; its position.
        source: [[f32; 4]; 3],
        /// Parents.
        parents: u32,
        /// 1: positions and quaternions are those of the frame, else the world's.
        framed: u32,
        /// 1: positions are (x/z, y/z, ln z).
        ray: u32,
        /// 1: scales are logarithms of pixels.
        log_px: u32,
        /// 1: opacities are logits.
        logit: u32,
        /// ln of the focal length, px.
        log_focal: f32,
        /// Smallest opacity of a logit.
        logit_low: f32,
        /// Smallest z, world units.
        z_min: f32,
        /// Bound of slopes.
        slope_max: f32,
        /// Smallest σ, world units.
        scale_min: f32,
        /// Unused.
        pad0: u32,
        /// Unused.
        pad1: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/occlusion.wgsl.
    OcclusionUniform {
        /// Points.
        points: u32,
        /// Views.
        views: u32,
        /// Height of the surfaces, px.
        height: u32,
        /// Width of the surfaces, px.
        width: u32,
        /// Tolerance and softness, shares of z.
        tolerance: f32,
        /// Unused.
        pad0: u32,
        /// Unused.
        pad1: u32,
        /// Unused.
        pad2: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/adapter.wgsl and adapter_colours.wgsl.
    AdapterUniform {
        /// Gaussians of all views.
        gaussians: u32,
        /// Pixels of a view.
        pixels: u32,
        /// Width of a view, px.
        width: u32,
        /// Gaussians of a pixel.
        per_pixel: u32,
        /// Numbers of a raw row.
        lanes: u32,
        /// SH functions of a colour.
        functions: u32,
        /// 1: SH have RGB innermost.
        interleaved: u32,
        /// Exponent of the opacity mapping.
        exponent: f32,
    }
}

uniform! {
    /// Parameters of wgsl/network/adam.wgsl.
    AdamUniform {
        /// Elements of the arrays, a multiple of 64.
        count: u32,
        /// Factor of the gradients.
        clip: f32,
        /// Decay of the first moment.
        first_decay: f32,
        /// Decay of the second moment.
        second_decay: f32,
        /// Term added to the root of the second moment.
        epsilon: f32,
        /// Decay of the moving average.
        average: f32,
        /// Unused.
        pad0: u32,
        /// Unused.
        pad1: u32,
    }
}

uniform! {
    /// Parameters of wgsl/shared/gather.wgsl; [`crate::layout::Gather`] documents the fields in full.
    AttentionGatherUniform {
        /// N.
        parents: u32,
        /// V.
        views: u32,
        /// L.
        levels: u32,
        /// M.
        points: u32,
        /// Floats of the points of one parent and view.
        points_width: u32,
        /// E.
        dim: u32,
        /// G.
        groups: u32,
        /// Floats of a cell's row.
        stride: u32,
        /// First key channel.
        key: u32,
        /// 1: there are keys.
        has_key: u32,
        /// First value channel.
        value: u32,
        /// 1: samples outside the map are left out of the softmax.
        renormalise: u32,
        /// 1: each level has points of its own.
        points_per_level: u32,
        /// ½ or 0, px.
        half_pixel: f32,
        /// Factor of q·k.
        logit_scale: f32,
        /// 1: dropout.
        drops: u32,
        /// 1 / (1 − p).
        kept_factor: f32,
        /// Index in the scene of the call's first parent.
        first_parent: u32,
        /// Low word of the seed.
        seed_low: u32,
        /// High word.
        seed_high: u32,
        /// Low word of ⌈p·2⁵³⌉: a weight is dropped where its 53 random bits are below it.
        dropped_low: u32,
        /// High word.
        dropped_high: u32,
        /// Number of cells of the maps.
        cells: u32,
        /// 1: the gradient of the points is computed.
        point_gradient: u32,
    }
}

uniform! {
    /// Parameters of wgsl/shared/sweep.wgsl; [`crate::layout::Sweep`] documents the fields in full.
    PlaneSweepUniform {
        /// R of the call.
        rows: u32,
        /// C.
        channels: u32,
        /// D.
        candidates: u32,
        /// h.
        height: u32,
        /// w.
        width: u32,
        /// Pairs of all rows.
        pairs: u32,
        /// S.
        sources: u32,
        /// Unused.
        pad0: u32,
        /// Coordinate of the centre of pixel 0.
        centre: f32,
        /// Smallest divisor z.
        min_z: f32,
        /// Factor of the correlation.
        scale: f32,
        /// Unused.
        pad1: u32,
    }
}

uniform! {
    /// Parameters of wgsl/network/invert.wgsl.
    InvertUniform {
        /// Number of entries.
        entries: u32,
        /// Number of cells that the entries refer to.
        cells: u32,
        /// Unused.
        pad0: u32,
        /// Unused.
        pad1: u32,
    }
}
