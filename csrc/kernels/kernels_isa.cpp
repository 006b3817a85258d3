// Compiled once per instruction set: GS_ISA is its name, and compiler flags enable it.
#include "adam.h"
#include "attention_bf16.h"
#include "blend.h"
#include "cover.h"
#include "kernels.h"
#include "muon.h"
#include "project.h"
#include "smooth.h"
#include "ssim.h"

namespace globalsplat::raster::GS_ISA {

#define GS_STRING2(x) #x
#define GS_STRING(x) GS_STRING2(x)

extern const Kernels table;
const Kernels table = {
    GS_STRING(GS_ISA),
    {project<float>, cover<float>, blend_tile<float>, blend_tile_backward<float>, count_tile<float>, project_backward<float>,
     ssim<float>, fit_gradient<float>, unevenness<float>, adam<float>},
    {project<double>, cover<double>, blend_tile<double>, blend_tile_backward<double>, count_tile<double>, project_backward<double>,
     ssim<double>, fit_gradient<double>, unevenness<double>, adam<double>},
    attend,
    pack_queries,
    attend_backward,
    attend_bf16,
    pack_queries_bf16,
    attend_backward_bf16,
    muon,
    multiply_adds,
};

}  // namespace globalsplat::raster::GS_ISA
