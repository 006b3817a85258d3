# Runs a command of COLMAP by pycolmap, with the options of COLMAP's own program.
# Arguments: COMMAND, and a JSON object of options: {"database_path": "…", "FeatureExtraction.use_gpu": false, …}.
import json
import os
import sys
import threading
from pathlib import Path

import pycolmap


def exit_with_parent():
    """Ends this process when standard input closes, as it does when the process that started it ends."""
    os.read(0, 1)
    os._exit(1)


threading.Thread(target=exit_with_parent, daemon=True).start()
pycolmap.logging.logtostderr = True
options = json.loads(sys.argv[2])
extraction, matching = pycolmap.FeatureExtractionOptions(), pycolmap.FeatureMatchingOptions()
pipeline = pycolmap.IncrementalPipelineOptions()
sections = {
    "ImageReader": pycolmap.ImageReaderOptions(),
    "FeatureExtraction": extraction,
    "SiftExtraction": extraction.sift,
    "FeatureMatching": matching,
    "Mapper": pipeline.mapper,
}
camera_mode = pycolmap.CameraMode.AUTO
for name in list(options):
    section, _, key = name.partition(".")
    if key == "single_camera_per_image":
        camera_mode = pycolmap.CameraMode.PER_IMAGE
    elif key:
        # COLMAP's program groups the options of the pipeline with those of the mapper.
        holder = sections[section] if hasattr(sections[section], key) else pipeline
        setattr(holder, key, options[name])

database = options.get("database_path")
if sys.argv[1] == "feature_extractor":
    names = Path(options["image_list_path"]).read_text(encoding="utf-8").splitlines()
    pycolmap.extract_features(
        database,
        options["image_path"],
        image_names=names,
        camera_mode=camera_mode,
        reader_options=sections["ImageReader"],
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )
elif sys.argv[1] == "matches_importer":
    pairing = pycolmap.ImportedPairingOptions(match_list_path=options["match_list_path"])
    pycolmap.match_image_pairs(database, matching_options=matching, pairing_options=pairing, device=pycolmap.Device.cpu)
elif sys.argv[1] == "spatial_matcher":
    pycolmap.match_spatial(database, matching_options=matching, device=pycolmap.Device.cpu)
elif sys.argv[1] == "mapper":
    pycolmap.incremental_mapping(database, options["image_path"], options["output_path"], options=pipeline)
elif sys.argv[1] == "bundle_adjuster":
    # A robust loss, for which COLMAP's own program has no option. Its scale, in terms of the median error, suits errors that are mostly
    # normally distributed.
    model = pycolmap.Reconstruction(options["input_path"])
    errors = sorted(point.error for point in model.points3D.values())
    adjustment = pycolmap.BundleAdjustmentOptions()
    adjustment.refine_principal_point = options["refine_principal_point"]
    solver = getattr(adjustment, "ceres", adjustment)
    solver.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    solver.loss_function_scale = 2 * errors[len(errors) // 2] if errors else 1
    pycolmap.bundle_adjustment(model, adjustment)
    model.write_binary(options["output_path"])
elif sys.argv[1] == "model_transformer":
    model = pycolmap.Reconstruction(options["input_path"])
    scale, w, x, y, z, *translation = map(float, Path(options["transform_path"]).read_text().split())
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d([x, y, z, w]), translation))
    model.write_binary(options["output_path"])
else:
    sys.exit(f"unknown command {sys.argv[1]}")
