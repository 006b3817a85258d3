"""Cases that cover each of the program's modules."""

FOLDERS = ("src/model", "src/loss")  # every file in these folders must have a case, or a reason for having none

CASES_OF = {
    "src/model/mod.rs": ["model", "model_16k"],
    "src/model/attention.rs": ["attention", "attention_large", "attention_bf16"],
    "src/model/camera_code.rs": ["camera_code"],
    "src/model/decoder.rs": ["heads", "decoder"],
    "src/model/encoder.rs": ["encoder"],
    "src/model/growth.rs": ["growth"],
    "src/model/merge.rs": ["merge"],
    "src/model/mixer.rs": ["mixer"],
    "src/model/precision.rs": ["linear", "linear_bf16"],
    "src/model/rotation.rs": ["rotation_matrix", "quaternion"],
    "src/model/stream.rs": ["stream_round", "self_attention_block"],
    "src/model/tokens.rs": ["patchify", "rgb_tokens", "ray_tokens", "tokens"],
    "src/data/jitter.rs": ["jitter"],
    "crates/capture/src/pixels/resample.rs": ["resample"],
    "src/loss/consistency.rs": ["consistency"],
    "src/loss/decoder_regularization.rs": ["decoder_regularization", "sh_soft_cap"],
    "src/loss/depth_smoothness.rs": ["depth_smoothness", "masked_depth_smoothness"],
    "src/loss/frustum.rs": ["frustum"],
    "src/loss/lpips.rs": ["lpips_vgg", "lpips_alex"],
    "src/loss/mask.rs": ["masked_photometric"],
    "src/loss/mse.rs": ["mse", "masked_mse"],
    "src/loss/perceptual.rs": ["perceptual"],
    "src/loss/photometric.rs": ["photometric", "ssim"],
    "src/loss/vgg19.rs": ["vgg19"],
    "crates/capture/src/geometry/normalize.rs": ["scene_normalization"],
    "src/stereo/depth_search.rs": ["depth_search", "semi_global_matching"],
    "src/scene/radial_warp.rs": ["radial_warp"],
    "src/scene/rays.rs": ["rays"],
    "src/reconstruct/colour_fit.rs": ["colour_fit"],
    "src/render/mod.rs": [
        "projection",
        "projection_float32",
        "projection_thin_float32",
        "rasterizer",
        "rasterizer_adversarial",
        "rasterizer_antialiased",
        "rasterizer_antialiased_float32",
        "rasterizer_float32",
        "rasterizer_adversarial_float32",
        "rasterizer_thin_float32",
    ],
    "src/train/curriculum.rs": ["stages"],
    "src/optim/muon.rs": ["muon"],
    "src/optim/optimizer.rs": ["adamw"],
    "src/train/schedule.rs": ["learning_rate"],
    "src/train/subsets.rs": ["subsets"],
}

EXCEPTED = {
    "src/model/config.rs": "the model's configuration; every case of a module uses it",
    "src/model/denormals.rs": "sets flush-to-zero for denormals; covered by its unit test",
    "src/model/layers.rs": "layers of stream.rs and mixer.rs; covered by their cases",
    "src/model/autograd.rs": "a backward pass in parts; src/train/step_tests.rs compares it with one in one piece",
    "src/model/memory.rs": "input of encoder.rs and stream.rs; covered by their cases, and view by view by its unit test",
    "src/model/flops.rs": "records FLOPs for benchmarks; covered by its unit test",
    "src/model/recompute.rs": "activation checkpointing of the encoder; src/train/step_tests.rs compares it with the plain pass",
    "src/model/shapes.rs": "infers a configuration from shapes; parity/tests/test_checkpoints.py compares it with models built in PyTorch",
    "src/loss/config.rs": "factors",
    "src/loss/terms.rs": "names of the terms, and their weighted sum; covered by its unit test",
    "src/loss/mod.rs": "inputs shared by the loss terms; each term has its own case",
}


def gaps(repository):
    """Returns the errors of the two maps with respect to the files on disk, as sentences."""
    found = []
    for folder in FOLDERS:
        for path in sorted((repository / folder).rglob("*.rs")):
            name = path.relative_to(repository).as_posix()
            if name not in CASES_OF and name not in EXCEPTED:
                found.append(f"{name} has no case in parity/harness/coverage.py")
    for name in [*CASES_OF, *EXCEPTED]:
        if not (repository / name).is_file():
            found.append(f"{name} has a case in parity/harness/coverage.py, and doesn't exist")
    return found
