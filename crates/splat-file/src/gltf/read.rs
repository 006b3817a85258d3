//! Gaussians of a glTF file.

use super::accessors::Components;
use super::container::{Document, quoted};
use super::json::{Primitive, Splatting};
use super::scene::MeshNode;
use super::{COLOR_SPACE, EXTENSION, KERNEL, POINTS, SPZ_EXTENSION, sh_attribute, turn_rotation_back};
use crate::axes::Axes;
use crate::codec::Contents;
use crate::invalid::InvalidGaussians;
use crate::splat::{log_of_scale, logit_of_opacity};
use crate::{Error, Result, SH_C0, Splat, spz};
use glam::DMat4;
use std::path::Path;

/// Maximum ratio of the size in memory to that of the file, with `MAX_SMALL` bytes allowed in addition: nodes can share meshes.
const MAX_RATIO: u128 = 256;
const MAX_SMALL: u128 = 1 << 20;

/// Reads the Gaussians of all primitives in the default scene, at the places of their nodes.
///
/// # Errors
/// Returns an error if there are none, or a node does more than rotate, scale uniformly and translate, or if the file is damaged,
/// truncated, or claims more than it can hold.
pub fn read(path: &Path, bytes: &[u8]) -> Result<Contents> {
    let document = Document::parse(path, bytes)?;
    let (mut parts, mut opacities) = (vec![], vec![]);
    let (mut others, mut memory) = (0, 0);
    let mut warnings = vec![];
    let mut warn = |warning: Option<String>| {
        if let Some(warning) = warning.filter(|warning| !warnings.contains(warning)) {
            warnings.push(warning);
        }
    };
    for place in document.mesh_nodes()? {
        let Some(mesh) = document.gltf.meshes.get(place.mesh) else {
            return Err(document.missing("mesh", place.mesh, document.gltf.meshes.len()));
        };
        for (index, primitive) in mesh.primitives.iter().enumerate() {
            let Some(splatting) = &primitive.extensions.splatting else {
                others += 1;
                continue;
            };
            let name = format!("primitive {index} of mesh {}", place.mesh);
            let reader = PrimitiveReader { document: &document, primitive, splatting, name };
            let part = reader.read(&mut memory, &mut opacities)?;
            warn(reader.unknown("kernel", splatting.kernel.as_deref(), KERNEL));
            warn(reader.unknown("colorSpace", splatting.color_space.as_deref(), COLOR_SPACE));
            parts.push(moved(path, part, &place)?);
        }
    }
    if parts.is_empty() {
        let found = format!("without Gaussian splats, but with {others} other mesh primitives");
        return Err(Error::input(path, "the scene", found, format!("a mesh primitive with {EXTENSION}")));
    }
    if others > 0 {
        let all = parts.len() + others;
        warn(Some(format!(
            "{}: {others} of {all} mesh primitives are left out, which aren't Gaussian splats",
            path.display()
        )));
    }
    let mut splat = Splat::concat(&parts.iter().collect::<Vec<_>>());
    splat.antialiased = parts.iter().all(|part| part.antialiased);
    Axes::LUF.convert_without_rotations(&mut splat);
    splat.quaternions.iter_mut().for_each(|quaternion| *quaternion = turn_rotation_back(*quaternion));
    splat.warnings = warnings;
    let mut invalid = InvalidGaussians::default();
    for (row, opacity) in opacities.into_iter().enumerate() {
        if !(0. ..=1.).contains(&opacity) {
            invalid.add(row, "opacity", || format!("the opacity of Gaussian {row}"), opacity, "0 to 1");
        }
    }
    invalid.add_all(&splat);
    Ok(Contents { splat, invalid })
}

/// Primitive whose Gaussians are read.
struct PrimitiveReader<'a> {
    document: &'a Document<'a>,
    primitive: &'a Primitive,
    splatting: &'a Splatting,
    /// Name of the primitive in messages.
    name: String,
}

impl PrimitiveReader<'_> {
    /// Returns the Gaussians in glTF's axes, without the transform of the node. Appends their opacities to `opacities`, and adds their size
    /// to `memory`, which is the size of all Gaussians read before.
    fn read(&self, memory: &mut u128, opacities: &mut Vec<f32>) -> Result<Splat> {
        if let Some(mode) = self.primitive.mode.filter(|&mode| mode != POINTS) {
            let field = format!("the mode of {}", self.name);
            return Err(Error::input(self.document.path, field, mode, format!("{POINTS} (POINTS)")));
        }
        let splat = match &self.splatting.extensions.spz {
            Some(spz) => {
                let splat = self.read_spz(spz.buffer_view)?;
                self.add_size(memory, splat.len(), splat.bases())?;
                opacities.extend((0..splat.len()).map(|index| splat.opacity(index)));
                splat
            }
            None => self.read_attributes(memory, opacities)?,
        };
        Ok(splat)
    }

    /// Reads the SPZ in a buffer view, whose numbers are in glTF's axes.
    fn read_spz(&self, view: usize) -> Result<Splat> {
        let path = self.document.path;
        let Some(codec) = &spz::CODEC else {
            let expected = "none, or a build of globalsplat-splat-file with its feature spz";
            return Err(Error::input(path, "the compression", SPZ_EXTENSION, expected));
        };
        let (bytes, _) = self.document.view(view)?;
        let mut splat = (codec.read)(path, bytes)?.splat;
        Axes::RUB.convert(&mut splat);
        Ok(splat)
    }

    fn read_attributes(&self, memory: &mut u128, opacities: &mut Vec<f32>) -> Result<Splat> {
        let position = self.require("POSITION")?;
        let count = self.document.accessor(position, "POSITION")?.count;
        let sh_degree = self.sh_degree();
        // Their buffer is read first: it counts as a part of the file.
        let means = self.document.numbers(position, "POSITION", count, Components::Any)?;
        self.add_size(memory, count, (sh_degree + 1).pow(2))?;
        let rotations: Vec<[f32; 4]> = self.extension("ROTATION", count, Components::NormalizedSigned)?;
        let scales: Vec<[f32; 3]> = self.extension("SCALE", count, Components::Any)?;
        let (dc, own_opacities) = self.colors(count)?;
        let first = opacities.len();
        opacities.extend(own_opacities);
        let mut rest: Vec<Vec<[f32; 3]>> = vec![];
        for degree in 1..=sh_degree {
            for index in 0..2 * degree + 1 {
                let name = sh_attribute(degree, index);
                let accessor = self.require(&name)?;
                rest.push(self.document.numbers(accessor, &name, count, Components::Normalized)?);
            }
        }
        let mut sh = Vec::with_capacity(count * (rest.len() + 1));
        for (index, color) in dc.into_iter().enumerate() {
            sh.push(color);
            sh.extend(rest.iter().map(|of_basis| of_basis[index]));
        }
        Ok(Splat {
            means,
            log_scales: scales.iter().map(|scale| scale.map(log_of_scale)).collect(),
            linear_scales: Some(scales),
            quaternions: rotations.into_iter().map(|[x, y, z, w]| [w, x, y, z]).collect(),
            opacity_logits: opacities[first..]
                .iter()
                .map(|&opacity| logit_of_opacity(f64::from(opacity)))
                .collect(),
            sh,
            sh_degree,
            ..Splat::default()
        })
    }

    /// Returns the spherical harmonics of degree 0 and the opacities. Either may come from COLOR_0, for files as of the extension's drafts.
    fn colors(&self, count: usize) -> Result<(Vec<[f32; 3]>, Vec<f32>)> {
        let (dc, opacity) = (sh_attribute(0, 0), format!("{EXTENSION}:OPACITY"));
        let fallback = |missing: &str| -> Result<Vec<[f32; 4]>> {
            let Some(&accessor) = self.primitive.attributes.get("COLOR_0") else {
                return Err(self.missing(missing));
            };
            if self.document.accessor(accessor, "COLOR_0")?.shape == "VEC3" && missing != opacity {
                let colors: Vec<[f32; 3]> =
                    self.document.numbers(accessor, "COLOR_0", count, Components::NormalizedUnsigned)?;
                return Ok(colors.into_iter().map(|[red, green, blue]| [red, green, blue, 1.]).collect());
            }
            self.document.numbers(accessor, "COLOR_0", count, Components::NormalizedUnsigned)
        };
        let to_dc = |color: f32| ((f64::from(color) - 0.5) / SH_C0) as f32;
        let harmonics = match self.primitive.attributes.get(&dc) {
            Some(&accessor) => self.document.numbers(accessor, &dc, count, Components::Normalized)?,
            None => fallback(&dc)?.into_iter().map(|[r, g, b, _]| [r, g, b].map(to_dc)).collect(),
        };
        let opacities = match self.primitive.attributes.get(&opacity) {
            Some(&accessor) => self
                .document
                .numbers::<1>(accessor, &opacity, count, Components::NormalizedUnsigned)?
                .into_flattened(),
            None => fallback(&opacity)?.into_iter().map(|[.., alpha]| alpha).collect(),
        };
        Ok((harmonics, opacities))
    }

    /// Returns the highest degree, up to 3, that has an attribute.
    fn sh_degree(&self) -> usize {
        let is_present = |degree: usize| {
            (0..2 * degree + 1)
                .any(|index| self.primitive.attributes.contains_key(&sh_attribute(degree, index)))
        };
        (1..=3).rev().find(|&degree| is_present(degree)).unwrap_or(0)
    }

    /// Reads an attribute of the extension.
    fn extension<const N: usize>(
        &self,
        name: &str,
        count: usize,
        components: Components,
    ) -> Result<Vec<[f32; N]>> {
        let name = format!("{EXTENSION}:{name}");
        self.document.numbers(self.require(&name)?, &name, count, components)
    }

    /// Returns the accessor of an attribute.
    fn require(&self, name: &str) -> Result<usize> {
        self.primitive.attributes.get(name).copied().ok_or_else(|| self.missing(name))
    }

    fn missing(&self, name: &str) -> Error {
        let field = format!("the attribute {name} of {}", self.name);
        Error::input(self.document.path, field, "missing", "one of every Gaussian splat")
    }

    /// Adds the size of Gaussians in memory to `memory`, before it is allocated.
    ///
    /// # Errors
    /// Returns an error if the sum is more than the file can reasonably hold.
    fn add_size(&self, memory: &mut u128, count: usize, bases: usize) -> Result<()> {
        let numbers = 3 + 3 + 3 + 4 + 1 + 3 * bases;
        *memory += count as u128 * (numbers * size_of::<f32>()) as u128;
        let length = self.document.size();
        if *memory > MAX_SMALL + MAX_RATIO * length as u128 {
            let found = format!("more than fit: {memory} bytes of them in files of {length}");
            let expected = format!("{MAX_RATIO} times the files' bytes at most");
            return Err(Error::input(self.document.path, "the number of Gaussians", found, expected));
        }
        Ok(())
    }

    /// Returns a warning if a property of the extension has an unknown value.
    fn unknown(&self, property: &str, found: Option<&str>, known: &str) -> Option<String> {
        let found = found.filter(|&found| found != known)?;
        Some(format!("{}: {property} {} is read as {known}", self.document.path.display(), quoted(found)))
    }
}

/// Returns the Gaussians of a mesh at the place of its node.
fn moved(path: &Path, splat: Splat, place: &MeshNode) -> Result<Splat> {
    if place.matrix == DMat4::IDENTITY {
        return Ok(splat);
    }
    splat.transformed(&place.matrix).map_err(|error| match error {
        Error::Setting { found, expected, .. } => {
            let field = format!("the transform of node {}, with those of its parents,", place.node);
            Error::input(path, field, found, expected)
        }
        other => other,
    })
}
