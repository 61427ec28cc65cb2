# Base 3D Gaussian Splatting: a fit, or supplied Gaussians (column gaussians of the scene sheet).
use rule stage as gaussians with:
    input:
        scene="<results>/{dataset}/{scene}/scene",
        existing=given(PLAN.data.gaussians("existing")),
        beside=given(PLAN.data.gaussians("beside")),
        dataparser=given(PLAN.data.gaussians("dataparser")),
        transforms=given(PLAN.data.gaussians("transforms")),
    output:
        out="<results>/{dataset}/{scene}/gaussians.ply",
        coordinates="<results>/{dataset}/{scene}/gaussians.json",
        report=directory("<results>/{dataset}/{scene}/gaussians"),
    log:
        PLAN.log("gaussians"),
    benchmark:
        PLAN.benchmark("gaussians")
    priority: 40
    resources:
        **RESOURCES.of("gaussians"),
    params:
        **PLAN.params("gaussians", files=PLAN.data.gaussians_files),
