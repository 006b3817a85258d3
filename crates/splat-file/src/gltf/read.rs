//! Gaussians of a glTF file: the primitives of the scene's nodes, with the numbers of their accessors.

use super::document::{Accessor, Document, Primitive, Splatting, quoted};
use super::{COLOR_SPACE, EXTENSION, KERNEL, POINTS, rotation_from_gltf, sh_attribute};
use crate::axes::Axes;
use crate::invalid::{Contents, InvalidGaussians};
use crate::numbers::Scalar;
use crate::splat::{color_to_sh0, logit_of_opacity};
use crate::{Error, Result, Splat, spz};
use glam::{DMat4, DQuat, DVec3};
use std::path::Path;

/// Maximum ratio of the size in memory to that of the file, with `MAX_SMALL` bytes allowed in addition: nodes can share meshes.
const MAX_RATIO: u128 = 256;
const MAX_SMALL: u128 = 1 << 20;

/// Reads the Gaussians of all primitives in the default scene, at the places of their nodes.
pub(crate) fn read(path: &Path, bytes: &[u8]) -> Result<Contents> {
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
        let mesh = document.get(&document.gltf.meshes, "mesh", place.mesh)?;
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
    splat.quaternions.iter_mut().for_each(|quaternion| *quaternion = rotation_from_gltf(*quaternion));
    splat.warnings = warnings;
    let mut invalid = InvalidGaussians::default();
    for (row, opacity) in opacities.into_iter().enumerate() {
        if !(0. ..=1.).contains(&opacity) {
            invalid.add(row, "opacity", || format!("the opacity of Gaussian {row}"), opacity, "0 to 1");
        }
    }
    Ok((splat, invalid))
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
        let Some(spz) = &self.splatting.extensions.spz else {
            return self.read_attributes(memory, opacities);
        };
        let (bytes, _) = self.document.view(spz.buffer_view)?;
        let (mut splat, _) = spz::read(self.document.path, bytes)?;
        // The numbers of an SPZ inside of glTF are in glTF's axes.
        Axes::RUB.convert(&mut splat);
        self.add_size(memory, splat.len(), splat.bases())?;
        opacities.extend((0..splat.len()).map(|index| splat.opacity(index)));
        Ok(splat)
    }

    fn read_attributes(&self, memory: &mut u128, opacities: &mut Vec<f32>) -> Result<Splat> {
        let count = self.document.accessor(self.require("POSITION")?, "POSITION")?.count;
        let sh_degree = self.sh_degree();
        // Their buffer is read first: it counts as a part of the file.
        let means = self.numbers("POSITION", count, Components::ANY)?;
        self.add_size(memory, count, (sh_degree + 1).pow(2))?;
        let rotations = self.numbers(&format!("{EXTENSION}:ROTATION"), count, Components::SIGNED)?;
        let scales = self.numbers(&format!("{EXTENSION}:SCALE"), count, Components::ANY)?;
        let (dc, own_opacities) = self.colors(count)?;
        let mut rest: Vec<Vec<[f32; 3]>> = vec![];
        for degree in 1..=sh_degree {
            for index in 0..2 * degree + 1 {
                rest.push(self.numbers(&sh_attribute(degree, index), count, Components::NORMALIZED)?);
            }
        }
        let mut splat = Splat { means, sh_degree, linear_scales: Some(vec![]), ..Splat::default() };
        scales.into_iter().for_each(|scale| splat.push_linear_scale(scale));
        splat.quaternions = rotations.into_iter().map(|[x, y, z, w]| [w, x, y, z]).collect();
        splat.opacity_logits =
            own_opacities.iter().map(|&opacity| logit_of_opacity(opacity.into())).collect();
        for (index, color) in dc.into_iter().enumerate() {
            splat.sh.push(color);
            splat.sh.extend(rest.iter().map(|of_basis| of_basis[index]));
        }
        opacities.extend(own_opacities);
        Ok(splat)
    }

    /// Returns the spherical harmonics of degree 0 and the opacities. Either may come from COLOR_0, for files as of the extension's drafts.
    fn colors(&self, count: usize) -> Result<(Vec<[f32; 3]>, Vec<f32>)> {
        let (dc, opacity) = (sh_attribute(0, 0), format!("{EXTENSION}:OPACITY"));
        let has = |name: &str| self.primitive.attributes.contains_key(name);
        let missing = [&dc, &opacity].into_iter().find(|name| !has(name));
        let mut colors: Vec<[f32; 4]> = vec![];
        if let Some(missing) = missing {
            let &accessor = self.primitive.attributes.get("COLOR_0").ok_or_else(|| self.missing(missing))?;
            let is_rgb = self.document.accessor(accessor, "COLOR_0")?.shape == "VEC3";
            colors = match is_rgb && has(&opacity) {
                true => {
                    let colors = self.numbers("COLOR_0", count, Components::UNSIGNED)?;
                    colors.into_iter().map(|[red, green, blue]| [red, green, blue, 1.]).collect()
                }
                false => self.numbers("COLOR_0", count, Components::UNSIGNED)?,
            };
        }
        let harmonics = match has(&dc) {
            true => self.numbers(&dc, count, Components::NORMALIZED)?,
            false => {
                let to_dc = |color: f32| color_to_sh0(color.into());
                colors.iter().map(|&[red, green, blue, _]| [red, green, blue].map(to_dc)).collect()
            }
        };
        let opacities = match has(&opacity) {
            true => self.numbers::<1>(&opacity, count, Components::UNSIGNED)?.into_flattened(),
            false => colors.iter().map(|color| color[3]).collect(),
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

    /// Returns the numbers of an attribute.
    fn numbers<const N: usize>(
        &self,
        name: &str,
        count: usize,
        components: Components,
    ) -> Result<Vec<[f32; N]>> {
        self.document.numbers(self.require(name)?, name, count, components)
    }

    /// Returns the accessor of an attribute.
    fn require(&self, name: &str) -> Result<usize> {
        self.primitive.attributes.get(name).copied().ok_or_else(|| self.missing(name))
    }

    fn missing(&self, name: &str) -> Error {
        let field = format!("the attribute {name} of {}", self.name);
        Error::input(self.document.path, field, "missing", "one of every Gaussian splat")
    }

    /// Adds the size of Gaussians in memory to `memory`, before it is allocated, and checks that the sum isn't more than the file can
    /// reasonably hold.
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

/// Node with a mesh.
struct MeshNode {
    node: usize,
    mesh: usize,
    /// Matrix that takes the mesh's coordinates to those of the scene.
    matrix: DMat4,
}

/// Types of components that an attribute may have, besides float.
#[derive(Clone, Copy)]
struct Components {
    are_allowed: fn(Scalar, bool) -> bool,
    names: &'static str,
}

impl Components {
    const SIGNED: Components = Components {
        are_allowed: |scalar, normalized| normalized && matches!(scalar, Scalar::I8 | Scalar::I16),
        names: "float (5126), or normalized byte (5120) or short (5122)",
    };
    const UNSIGNED: Components = Components {
        are_allowed: |scalar, normalized| normalized && matches!(scalar, Scalar::U8 | Scalar::U16),
        names: "float (5126), or normalized unsigned byte (5121) or unsigned short (5123)",
    };
    const NORMALIZED: Components = Components {
        are_allowed: |_, normalized| normalized,
        names: "float (5126), or normalized numbers of one or two bytes (5120 to 5123)",
    };
    const ANY: Components = Components {
        are_allowed: |_, _| true,
        names: "float (5126), or numbers of one or two bytes (5120 to 5123)",
    };
}

impl Document<'_> {
    /// Returns the nodes of the default scene that have a mesh, depth first. A file without a default scene has its first scene, or all
    /// nodes if it has no scene.
    fn mesh_nodes(&self) -> Result<Vec<MeshNode>> {
        let (nodes, scenes) = (&self.gltf.nodes, &self.gltf.scenes);
        let roots = match self.gltf.scene.or(if scenes.is_empty() { None } else { Some(0) }) {
            Some(index) => self.get(scenes, "scene", index)?.nodes.clone(),
            None => {
                let mut is_root = vec![true; nodes.len()];
                for &child in nodes.iter().flat_map(|node| &node.children) {
                    if let Some(is_root) = is_root.get_mut(child) {
                        *is_root = false;
                    }
                }
                (0..nodes.len()).filter(|&index| is_root[index]).collect()
            }
        };
        let mut is_visited = vec![false; nodes.len()];
        let mut found = vec![];
        // Nodes to visit with the matrices of their parents, the next one last.
        let mut next: Vec<(usize, DMat4)> = roots.iter().rev().map(|&root| (root, DMat4::IDENTITY)).collect();
        while let Some((index, parent)) = next.pop() {
            let node = self.get(nodes, "node", index)?;
            if std::mem::replace(&mut is_visited[index], true) {
                let expected = "a tree, in which every node has one parent at most";
                return Err(Error::input(self.path, format!("node {index}"), "reached twice", expected));
            }
            let of_parts = || {
                DMat4::from_scale_rotation_translation(
                    node.scale.unwrap_or(DVec3::ONE),
                    node.rotation.map_or(DQuat::IDENTITY, DQuat::normalize),
                    node.translation.unwrap_or(DVec3::ZERO),
                )
            };
            let matrix = parent * node.matrix.unwrap_or_else(of_parts);
            found.extend(node.mesh.map(|mesh| MeshNode { node: index, mesh, matrix }));
            next.extend(node.children.iter().rev().map(|&child| (child, matrix)));
        }
        Ok(found)
    }

    /// Returns accessor `index`, that of the attribute `name`.
    fn accessor(&self, index: usize, name: &str) -> Result<&Accessor> {
        self.get(&self.gltf.accessors, &format!("the accessor of {name},"), index)
    }

    /// Reads accessor `index`, that of the attribute `name`, which must have `count` elements of `N` numbers.
    fn numbers<const N: usize>(
        &self,
        index: usize,
        name: &str,
        count: usize,
        components: Components,
    ) -> Result<Vec<[f32; N]>> {
        let accessor = self.accessor(index, name)?;
        let error = |field: &str, found: String, expected: &str| {
            Error::input(self.path, format!("{field} of accessor {index} ({name})"), found, expected)
        };
        let shape = if N == 1 { "SCALAR".to_string() } else { format!("VEC{N}") };
        if accessor.shape != shape {
            return Err(error("the type", quoted(&accessor.shape), &shape));
        }
        // The largest number of a type is 1 if numbers are normalized.
        let (scalar, largest) = match accessor.component_type {
            5120 => (Some(Scalar::I8), f64::from(i8::MAX)),
            5121 => (Some(Scalar::U8), f64::from(u8::MAX)),
            5122 => (Some(Scalar::I16), f64::from(i16::MAX)),
            5123 => (Some(Scalar::U16), f64::from(u16::MAX)),
            5126 => (Some(Scalar::F32), 1.),
            _ => (None, 1.),
        };
        let is_allowed = |scalar: &Scalar| {
            *scalar == Scalar::F32 || (components.are_allowed)(*scalar, accessor.normalized)
        };
        let Some(scalar) = scalar.filter(is_allowed) else {
            let normalized = if accessor.normalized { ", normalized" } else { "" };
            let found = format!("{}{normalized}", accessor.component_type);
            return Err(error("the component type", found, components.names));
        };
        if accessor.count != count {
            let expected = format!("{count}, as many as positions");
            return Err(error("the number of elements", accessor.count.to_string(), &expected));
        }
        if accessor.sparse.is_some() {
            return Err(error("the storage", "sparse".into(), "all elements in a buffer view"));
        }
        let missing = || error("the buffer view", "missing".into(), "one");
        let view = accessor.buffer_view.ok_or_else(missing)?;
        let (bytes, stride) = self.view(view)?;
        let size = N * scalar.size();
        let stride = stride.unwrap_or(size);
        if stride < size {
            return Err(error("the stride", stride.to_string(), &format!("{size} bytes or more")));
        }
        let end =
            accessor.byte_offset as u128 + count.saturating_sub(1) as u128 * stride as u128 + size as u128;
        if count == 0 || end > bytes.len() as u128 {
            let found = format!("{count} elements, which end at byte {end}");
            let expected = format!("1 or more, within the {} bytes of buffer view {view}", bytes.len());
            return Err(error("the extent", found, &expected));
        }
        let number = |bytes: &[u8]| {
            let number = scalar.read(bytes);
            let is_fraction = accessor.normalized && scalar != Scalar::F32;
            if is_fraction { (number / largest).max(-1.) as f32 } else { number as f32 }
        };
        let element = |index: usize| -> [f32; N] {
            let bytes = &bytes[accessor.byte_offset + index * stride..];
            std::array::from_fn(|part| number(&bytes[part * scalar.size()..]))
        };
        Ok((0..count).map(element).collect())
    }
}
