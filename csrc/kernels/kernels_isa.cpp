// Compiled once per instruction set: GS_ISA is its name, and compiler flags enable it.
#include "attention_bf16.h"
#include "blend.h"
#include "kernels.h"
#include "optim.h"
#include "plane_sweep.h"
#include "project.h"
#include "semi_global.h"
#include "smoothness.h"
#include "ssim.h"
#include "touched_tiles.h"

namespace globalsplat::raster::GS_ISA {

#define GS_STRING2(x) #x
#define GS_STRING(x) GS_STRING2(x)

extern const Kernels table;
const Kernels table = {
    GS_STRING(GS_ISA),
    {project<float>, list_touched_tiles<float>, blend_tile<float>, blend_tile_backward<float>, count_pairs<float>, project_backward<float>,
     ssim<float>, photometric_gradient<float>, unevenness<float>, adam<float>},
    {project<double>, list_touched_tiles<double>, blend_tile<double>, blend_tile_backward<double>, count_pairs<double>,
     project_backward<double>, ssim<double>, photometric_gradient<double>, unevenness<double>, adam<double>},
    attention_forward,
    pack_queries,
    attention_backward,
    attention_forward_bf16,
    pack_queries_bf16,
    attention_backward_bf16,
    muon,
    sweep_planes,
    patch_variances,
    costs_of_rows,
    sum_paths,
    choose_planes,
    multiply_adds,
};

}  // namespace globalsplat::raster::GS_ISA
