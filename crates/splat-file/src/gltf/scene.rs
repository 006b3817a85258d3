//! Nodes of the scene that is read, with their transforms.

use super::container::Document;
use super::json::Node;
use crate::{Error, Result};
use glam::{DMat4, DQuat, DVec3};

/// Node with a mesh.
pub struct MeshNode {
    pub node: usize,
    pub mesh: usize,
    /// Matrix that takes the mesh's coordinates to those of the scene.
    pub matrix: DMat4,
}

impl Document<'_> {
    /// Returns the nodes of the default scene that have a mesh, depth first. A file without a default scene has its first scene, or all
    /// nodes if it has no scene.
    ///
    /// # Errors
    /// Returns an error if a scene or node is missing, or a node has two parents.
    pub fn mesh_nodes(&self) -> Result<Vec<MeshNode>> {
        let (nodes, scenes) = (&self.gltf.nodes, &self.gltf.scenes);
        let roots = match self.gltf.scene.or(if scenes.is_empty() { None } else { Some(0) }) {
            Some(index) => match scenes.get(index) {
                Some(scene) => scene.nodes.clone(),
                None => return Err(self.missing("scene", index, scenes.len())),
            },
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
            let Some(node) = nodes.get(index) else {
                return Err(self.missing("node", index, nodes.len()));
            };
            if std::mem::replace(&mut is_visited[index], true) {
                let expected = "a tree, in which every node has one parent at most";
                return Err(Error::input(self.path, format!("node {index}"), "reached twice", expected));
            }
            let matrix = match local_matrix(node) {
                Some(matrix) => parent * matrix,
                None => parent,
            };
            found.extend(node.mesh.map(|mesh| MeshNode { node: index, mesh, matrix }));
            next.extend(node.children.iter().rev().map(|&child| (child, matrix)));
        }
        Ok(found)
    }
}

/// Returns the matrix of a node, or `None` for the identity.
fn local_matrix(node: &Node) -> Option<DMat4> {
    if let Some(matrix) = node.matrix {
        return Some(DMat4::from_cols_array(&matrix));
    }
    let Node { translation, rotation, scale, .. } = node;
    if translation.is_none() && rotation.is_none() && scale.is_none() {
        return None;
    }
    Some(DMat4::from_scale_rotation_translation(
        scale.map_or(DVec3::ONE, DVec3::from_array),
        rotation.map_or(DQuat::IDENTITY, |rotation| DQuat::from_array(rotation).normalize()),
        translation.map_or(DVec3::ZERO, DVec3::from_array),
    ))
}
