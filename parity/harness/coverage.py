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
    "src/data/pixels/jitter.rs": ["jitter"],
    "src/data/pixels/resample.rs": ["resample"],
    "src/loss/consistency.rs": ["consistency"],
    "src/loss/decoder_regularization.rs": ["decoder_regularization", "sh_soft_cap"],
    "src/loss/depth_smoothness.rs": ["depth_smoothness"],
    "src/loss/frustum.rs": ["frustum"],
    "src/loss/lpips.rs": ["lpips_vgg", "lpips_alex"],
    "src/loss/mse.rs": ["mse"],
    "src/loss/perceptual.rs": ["perceptual"],
    "src/loss/photometric.rs": ["photometric", "ssim"],
    "src/loss/vgg19.rs": ["vgg19"],
    "src/scene/normalize.rs": ["scene_normalization"],
    "src/scene/rays.rs": ["rays"],
    "src/render/mod.rs": [
        "projection",
        "projection_float32",
        "projection_thin_float32",
        "rasterizer",
        "rasterizer_adversarial",
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
    "src/model/config.rs": "a model's numbers; every case of a module reads them",
    "src/model/denormals.rs": "how the processor takes numbers that no result depends on, which its own test looks at",
    "src/model/layers.rs": "what stream.rs and mixer.rs are made of, and held with them",
    "src/model/autograd.rs": "a backward pass in parts, which src/train/step_tests.rs holds against one in one piece",
    "src/model/memory.rs": "what encoder.rs and stream.rs read, and held with them; view by view by its own test",
    "src/model/parts.rs": "tells what is done, and does nothing",
    "src/model/recompute.rs": "another order of the encoder's pass, which src/train/step_tests.rs holds against the plain one",
    "src/model/shapes.rs": "a configuration read off shapes; parity/tests/test_checkpoints.py holds it against models made here",
    "src/loss/config.rs": "factors",
    "src/loss/terms.rs": "names of the terms, and their weighted sum, which its own test holds",
    "src/loss/mod.rs": "what the terms look at; they are held one by one",
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
