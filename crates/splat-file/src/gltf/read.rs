//! Gaussians of a glTF file: the primitives of the scene's nodes.

use super::document::{Document, Primitive, quoted};
use super::{COLOR_SPACE, EXTENSION, KERNEL, POINTS, SPZ_EXTENSION, rotation_from_gltf, sh_attribute};
use crate::axes::Axes;
use crate::numbers::ClaimedGaussians;
use crate::splat::{color_to_sh0, logit_of_opacity};
use crate::{Error, Result, Splat, spz};
use glam::{DMat4, DQuat, DVec3};
use serde_json::Value;
use std::collections::BTreeSet;
use std::path::Path;

/// Reads the Gaussians of all primitives in the default scene, at the places of their nodes.
pub(crate) fn read(path: &Path, bytes: &[u8]) -> Result<Splat> {
    let document = Document::parse(path, bytes)?;
    let (mut parts, mut others, mut claimed) = (vec![], 0, ClaimedGaussians::default());
    let mut warnings = BTreeSet::new();
    for MeshNode { node, mesh, matrix } in mesh_nodes(&document)? {
        for (index, primitive) in
            document.get(&document.gltf.meshes, "mesh", mesh)?.primitives.iter().enumerate()
        {
            let Some(splatting) = primitive.extensions.get(EXTENSION) else {
                others += 1;
                continue;
            };
            for (property, known) in [("kernel", KERNEL), ("colorSpace", COLOR_SPACE)] {
                let found = splatting[property].as_str().filter(|&found| found != known);
                warnings
                    .extend(found.map(|found| format!("{property} {} is read as {known}", quoted(found))));
            }
            let name = format!("primitive {index} of mesh {mesh}");
            let part =
                PrimitiveReader { document: &document, primitive, name }.read(splatting, &mut claimed)?;
            parts.push(if matrix == DMat4::IDENTITY { part } else { moved(path, &part, &matrix, node)? });
        }
    }
    if parts.is_empty() {
        let found = format!("without Gaussian splats, but with {others} other mesh primitives");
        return Err(Error::input(path, "the scene", found, format!("a mesh primitive with {EXTENSION}")));
    }
    if others > 0 {
        let all = parts.len() + others;
        warnings
            .insert(format!("{others} of {all} mesh primitives are left out, which aren't Gaussian splats"));
    }
    if document.has_log_scales() {
        warnings.insert("scales are read as logarithms, as splat-transform wrote them before 2.7".into());
    }
    let mut splat = Splat::concat(&parts.iter().collect::<Vec<_>>());
    splat.antialiased = parts.iter().all(|part| part.antialiased);
    Axes::LUF.convert_without_rotations(&mut splat);
    splat.quaternions.iter_mut().for_each(|quaternion| *quaternion = rotation_from_gltf(*quaternion));
    splat.warnings = warnings.iter().map(|warning| format!("{}: {warning}", path.display())).collect();
    Ok(splat)
}

/// Returns the Gaussians of a mesh at the place of its node.
fn moved(path: &Path, splat: &Splat, matrix: &DMat4, node: usize) -> Result<Splat> {
    splat.transformed(matrix).map_err(|error| match error {
        Error::Setting { found, expected, .. } => {
            let field = format!("the transform of node {node}, with those of its parents,");
            Error::input(path, field, found, expected)
        }
        other => other,
    })
}

/// Primitive whose Gaussians are read.
struct PrimitiveReader<'a> {
    document: &'a Document<'a>,
    primitive: &'a Primitive,
    /// Name of the primitive in messages.
    name: String,
}

impl PrimitiveReader<'_> {
    /// Returns the Gaussians in glTF's axes, without the transform of the node. `splatting` is the primitive's extension; they are
    /// added to `claimed`, since nodes can share meshes.
    fn read(&self, splatting: &Value, claimed: &mut ClaimedGaussians) -> Result<Splat> {
        let &Document { path, size, .. } = self.document;
        if let Some(mode) = self.primitive.mode.filter(|&mode| mode != POINTS) {
            let field = format!("the mode of {}", self.name);
            return Err(Error::input(path, field, mode, format!("{POINTS} (POINTS)")));
        }
        if let Some(view) = splatting["extensions"][SPZ_EXTENSION]["bufferView"].as_u64() {
            let mut splat = spz::read(path, self.document.view(view as usize)?.0)?;
            // The numbers of an SPZ inside of glTF are in glTF's axes.
            Axes::RUB.convert(&mut splat);
            claimed.add(path, splat.len(), splat.sh_degree, size)?;
            return Ok(splat);
        }
        let count = self.document.accessor(self.index_of("POSITION")?, "POSITION")?.count;
        let is_present = |name: String| self.primitive.attributes.contains_key(&name);
        let has_degree = |&degree: &usize| (0..2 * degree + 1).any(|k| is_present(sh_attribute(degree, k)));
        let sh_degree = (1..=3).rev().find(has_degree).unwrap_or(0);
        let means = self.numbers("POSITION", count)?;
        claimed.add(path, count, sh_degree, size)?;
        let own = |name: &str| format!("{EXTENSION}:{name}");
        let rotations = self.numbers(&own("ROTATION"), count)?;
        let opacities = self.numbers_or_colors(&own("OPACITY"), count, |[.., opacity]| [opacity])?;
        let mut splat = Splat { means, sh_degree, linear_scales: Some(vec![]), ..Splat::default() };
        splat.quaternions = rotations.into_iter().map(|[x, y, z, w]| [w, x, y, z]).collect();
        splat.opacity_logits =
            opacities.into_iter().map(|[opacity]| logit_of_opacity(f32::into(opacity))).collect();
        let scales: Vec<[f32; 3]> = self.numbers(&own("SCALE"), count)?;
        if self.document.has_log_scales() {
            (splat.log_scales, splat.linear_scales) = (scales, None);
        } else if 2 * scales.as_flattened().iter().filter(|&&scale| scale < 0.).count() > 3 * count {
            let field = format!("the attribute {} of {}", own("SCALE"), self.name);
            let expected =
                "lengths of 0 or more; only those of splat-transform before 2.7 are read as logarithms";
            return Err(Error::input(path, field, "negative for the most part", expected));
        } else {
            scales.into_iter().for_each(|scale| splat.push_linear_scale(scale));
        }
        let to_sh0 = |color: f32| color_to_sh0(color.into());
        let sh0 = self.numbers_or_colors(&sh_attribute(0, 0), count, |[r, g, b, _]| [r, g, b].map(to_sh0));
        let mut harmonics: Vec<Vec<[f32; 3]>> = vec![sh0?];
        for degree in 1..=sh_degree {
            for k in 0..2 * degree + 1 {
                harmonics.push(self.numbers(&sh_attribute(degree, k), count)?);
            }
        }
        splat.sh =
            (0..count).flat_map(|index| harmonics.iter().map(move |of_basis| of_basis[index])).collect();
        Ok(splat)
    }

    /// Returns the numbers of an attribute of the extension. If it is absent, returns `part_of` COLOR_0, as in files of the extension's drafts.
    fn numbers_or_colors<const N: usize>(
        &self,
        name: &str,
        count: usize,
        part_of: impl Fn([f32; 4]) -> [f32; N],
    ) -> Result<Vec<[f32; N]>> {
        const COLORS: &str = "COLOR_0";
        let is_present = |name: &str| self.primitive.attributes.contains_key(name);
        if is_present(name) || !is_present(COLORS) {
            return self.numbers(name, count);
        }
        Ok(self.numbers(COLORS, count)?.into_iter().map(part_of).collect())
    }

    /// Returns the numbers of an attribute.
    fn numbers<const N: usize>(&self, name: &str, count: usize) -> Result<Vec<[f32; N]>> {
        self.document.numbers(self.index_of(name)?, name, count)
    }

    /// Returns the index of the accessor of an attribute.
    fn index_of(&self, name: &str) -> Result<usize> {
        self.primitive.attributes.get(name).copied().ok_or_else(|| {
            let field = format!("the attribute {name} of {}", self.name);
            Error::input(self.document.path, field, "missing", "one of every Gaussian splat")
        })
    }
}

/// Node with a mesh.
struct MeshNode {
    node: usize,
    mesh: usize,
    /// Matrix that takes the mesh's coordinates to those of the scene.
    matrix: DMat4,
}

/// Returns the nodes of the default scene, or else of the first one, that have a mesh, depth first.
fn mesh_nodes(document: &Document) -> Result<Vec<MeshNode>> {
    let (nodes, scenes) = (&document.gltf.nodes, &document.gltf.scenes);
    let roots = &document.get(scenes, "scene", document.gltf.scene)?.nodes;
    let mut is_visited = vec![false; nodes.len()];
    let mut found = vec![];
    // Nodes to visit with the matrices of their parents, the next one last.
    let mut next: Vec<(usize, DMat4)> = roots.iter().rev().map(|&root| (root, DMat4::IDENTITY)).collect();
    while let Some((index, parent)) = next.pop() {
        let node = document.get(nodes, "node", index)?;
        if std::mem::replace(&mut is_visited[index], true) {
            let expected = "a tree, in which every node has one parent at most";
            return Err(Error::input(document.path, format!("node {index}"), "reached twice", expected));
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
