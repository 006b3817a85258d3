//! Triangle meshes with texture coordinates.

use glam::{Affine3A, Vec2, Vec3};

/// A triangle mesh of one or more surfaces. Lengths are in metres.
#[derive(Debug, Clone, Default)]
pub(super) struct Mesh {
    pub positions: Vec<Vec3>,
    /// Texture coordinates of the vertices, in metres along the surface.
    pub uvs: Vec<Vec2>,
    /// Vertex indices of each triangle, counter-clockwise when seen from outside.
    pub triangles: Vec<[u32; 3]>,
}

impl Mesh {
    /// Creates the surface `at(u, v)` over the unit square, in `columns` × `rows` cells. The texture is `size` metres wide and
    /// high. The outside is in the direction of ∂at/∂u × ∂at/∂v.
    pub fn grid(columns: usize, rows: usize, size: Vec2, at: impl Fn(f32, f32) -> Vec3) -> Mesh {
        let mut mesh = Mesh::default();
        for row in 0..=rows {
            for column in 0..=columns {
                let place = Vec2::new(column as f32 / columns as f32, row as f32 / rows as f32);
                mesh.positions.push(at(place.x, place.y));
                mesh.uvs.push(place * size);
            }
        }
        let vertex = |column: usize, row: usize| (row * (columns + 1) + column) as u32;
        for row in 0..rows {
            for column in 0..columns {
                let [a, b] = [vertex(column, row), vertex(column + 1, row)];
                let [c, d] = [vertex(column, row + 1), vertex(column + 1, row + 1)];
                mesh.triangles.extend([[a, b, d], [a, d, c]]);
            }
        }
        mesh
    }

    /// Creates the rectangle at `corner` along two sides, in cells of at most `cell` metres. The outside is in the direction of
    /// `along` × `up`.
    pub fn rectangle(corner: Vec3, along: Vec3, up: Vec3, cell: f32) -> Mesh {
        let size = Vec2::new(along.length(), up.length());
        let cells = (size / cell).ceil().clamp(Vec2::ONE, Vec2::splat(64.));
        Mesh::grid(cells.x as usize, cells.y as usize, size, |u, v| corner + u * along + v * up)
    }

    pub fn join(&mut self, other: Mesh) {
        let first = self.positions.len() as u32;
        self.positions.extend(other.positions);
        self.uvs.extend(other.uvs);
        self.triangles.extend(other.triangles.iter().map(|corners| corners.map(|vertex| first + vertex)));
    }

    /// Returns the mesh transformed by `by`. The texture keeps its size.
    pub fn moved(self, by: Affine3A) -> Mesh {
        self.warped(|position| by.transform_point3(position))
    }

    /// Returns the mesh with every vertex mapped by `to`.
    pub fn warped(mut self, to: impl Fn(Vec3) -> Vec3) -> Mesh {
        self.positions.iter_mut().for_each(|position| *position = to(*position));
        self
    }

    /// Returns the bounding box: its minimum and maximum corners.
    pub fn bounds(&self) -> (Vec3, Vec3) {
        let none = (Vec3::INFINITY, Vec3::NEG_INFINITY);
        self.positions.iter().fold(none, |(least, most), &p| (least.min(p), most.max(p)))
    }

    /// Returns for every vertex a point on its triangles, a fifth of the way to their centres. A vertex itself may lie on the edge
    /// where another surface begins, with anything behind it.
    pub fn insides(&self) -> Vec<Vec3> {
        let mut sums = vec![(Vec3::ZERO, 0.); self.positions.len()];
        for corners in &self.triangles {
            let middle = corners.map(|vertex| self.positions[vertex as usize]).iter().sum::<Vec3>() / 3.;
            for &vertex in corners {
                let (sum, count) = &mut sums[vertex as usize];
                (*sum, *count) = (*sum + middle, *count + 1.);
            }
        }
        let inside = |(&at, &(sum, count)): (&Vec3, &(Vec3, f32))| at.lerp(sum / f32::max(count, 1.), 0.2);
        self.positions.iter().zip(&sums).map(inside).collect()
    }

    /// Returns a unit normal per vertex, the area-weighted mean of its triangles' normals: smooth within a grid, sharp between
    /// grids.
    pub fn normals(&self) -> Vec<Vec3> {
        let mut normals = vec![Vec3::ZERO; self.positions.len()];
        for corners in &self.triangles {
            let [a, b, c] = corners.map(|vertex| self.positions[vertex as usize]);
            let normal = (b - a).cross(c - a);
            corners.iter().for_each(|&vertex| normals[vertex as usize] += normal);
        }
        normals.into_iter().map(|normal| normal.normalize_or(Vec3::Y)).collect()
    }
}
