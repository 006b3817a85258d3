//! Positions of photos on the earth: OpenDroneMap's `geo.txt`, and local coordinates in metres.

use glam::DVec3;
use globalsplat_files::{Error, Result, read_text};
use proj4rs::Proj;
use proj4rs::transform::transform;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// Name of the file that lists positions of photos.
pub const GEO_FILE: &str = "geo.txt";

/// Longitude and latitude in degrees, as GPS gives them.
const WGS84: &str = "+proj=longlat +datum=WGS84 +no_defs";
/// Semi-major axis in metres and flattening of the ellipsoid of WGS 84.
const SEMI_MAJOR_AXIS: f64 = 6_378_137.;
const FLATTENING: f64 = 1. / 298.257_223_563;

/// A position in the World Geodetic System (WGS 84).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct GeoPosition {
    /// Longitude in degrees, east above 0.
    pub longitude: f64,
    /// Latitude in degrees, north above 0.
    pub latitude: f64,
    /// Height in metres, if it is known.
    pub altitude: Option<f64>,
}

impl GeoPosition {
    /// Returns the position if its numbers are in their ranges.
    pub(crate) fn new(longitude: f64, latitude: f64, altitude: Option<f64>) -> Option<Self> {
        let is_valid =
            longitude.abs() <= 180. && latitude.abs() <= 90. && altitude.is_none_or(f64::is_finite);
        is_valid.then_some(GeoPosition { longitude, latitude, altitude })
    }

    /// Returns the coordinates in metres from the earth's center, x towards longitude 0 and z towards the North Pole (EPSG method 9602).
    fn geocentric(&self, height: f64) -> DVec3 {
        let ((sin, cos), (y, x)) =
            (self.latitude.to_radians().sin_cos(), self.longitude.to_radians().sin_cos());
        let squared_eccentricity = FLATTENING * (2. - FLATTENING);
        let radius = SEMI_MAJOR_AXIS / (1. - squared_eccentricity * sin * sin).sqrt();
        let across = (radius + height) * cos;
        DVec3::new(across * x, across * y, (radius * (1. - squared_eccentricity) + height) * sin)
    }
}

/// Returns `positions` in metres to the east, to the north and upwards of the first one that is known. Unknown altitudes are the mean of
/// the known ones.
pub fn to_east_north_up(positions: &[Option<GeoPosition>]) -> Vec<Option<DVec3>> {
    let known = || positions.iter().flatten();
    let Some(origin) = known().next() else { return vec![None; positions.len()] };
    let altitudes: Vec<f64> = known().filter_map(|position| position.altitude).collect();
    let mean = altitudes.iter().sum::<f64>() / altitudes.len().max(1) as f64;
    let ((sin, cos), (y, x)) =
        (origin.latitude.to_radians().sin_cos(), origin.longitude.to_radians().sin_cos());
    let (east, up) = (DVec3::new(-y, x, 0.), DVec3::new(cos * x, cos * y, sin));
    let north = up.cross(east);
    let center = origin.geocentric(mean);
    let local = |position: &GeoPosition| {
        let offset = position.geocentric(position.altitude.unwrap_or(mean)) - center;
        DVec3::new(east.dot(offset), north.dot(offset), up.dot(offset))
    };
    positions.iter().map(|position| position.as_ref().map(local)).collect()
}

/// Reads the positions of photos from `file`, by the names of the photos, in the format of OpenDroneMap's `geo.txt`: first the coordinate
/// system, as `EPSG:4326` (longitude and latitude in degrees), `EPSG:326zz` or `EPSG:327zz` and `WGS84 UTM 32N` (zones of UTM) or a definition
/// for PROJ that begins with `+proj`; then a line for each photo, its name, x, y, perhaps the altitude in metres, and numbers that aren't used.
///
/// # Errors
/// Returns an error if the file can't be read, or that names the line that violates the format.
pub fn read_geo_positions(file: &Path) -> Result<BTreeMap<String, GeoPosition>> {
    let text = read_text(file)?;
    let mut lines =
        (1..).zip(text.lines()).filter(|(_, line)| !line.trim().is_empty() && !line.starts_with('#'));
    let (number, system) = lines.next().unwrap_or((1, ""));
    let refuse = |number: usize, what: &str, found: &str, expected: &str| {
        Error::input(file, format!("{what} in line {number}"), format!("{found:?}"), expected)
    };
    let source =
        find_projection(system.trim()).and_then(|definition| Proj::from_proj_string(&definition).ok());
    let source = source.ok_or_else(|| {
        let expected = "EPSG:4326, EPSG:326zz, EPSG:327zz, WGS84 UTM with a zone as 32N, or a definition as +proj=utm +zone=32";
        refuse(number, "the coordinate system", system, expected)
    })?;
    let target = Proj::from_proj_string(WGS84).expect("a valid definition");
    let mut positions = BTreeMap::new();
    for (number, line) in lines {
        let mut words = line.split_whitespace();
        let name = words.next().unwrap_or_default();
        let numbers: Option<Vec<f64>> = words.take(3).map(|word| word.parse().ok()).collect();
        let position = match numbers.as_deref() {
            Some([x, y, rest @ ..]) => locate(&source, &target, *x, *y, rest.first().copied()),
            _ => None,
        };
        let expected = "a photo's name, its x, y in that coordinate system, and perhaps its altitude";
        let position = position.ok_or_else(|| refuse(number, "the position", line, expected))?;
        if positions.insert(name.to_string(), position).is_some() {
            return Err(refuse(number, "the name", name, "each name once"));
        }
    }
    Ok(positions)
}

/// Returns PROJ's definition of the coordinate system that the first line of a `geo.txt` names.
fn find_projection(system: &str) -> Option<String> {
    let system = system.to_ascii_lowercase();
    if system.starts_with("+proj") {
        return Some(system);
    }
    let zone = |number: &str, is_south: bool| {
        let number: u8 = number.parse().ok().filter(|number| (1..=60).contains(number))?;
        let south = if is_south { " +south" } else { "" };
        Some(format!("+proj=utm +zone={number}{south} +datum=WGS84 +units=m +no_defs"))
    };
    match system.strip_prefix("epsg:").map(str::trim) {
        Some("4326") => return Some(WGS84.into()),
        Some(code) if code.len() == 5 => {
            return zone(code.strip_prefix("326").or(code.strip_prefix("327"))?, code.starts_with("327"));
        }
        _ => {}
    }
    let words: Vec<&str> = system.split_whitespace().collect();
    let ["wgs84", "utm", name] = words[..] else { return None };
    zone(name.strip_suffix(['n', 's'])?, name.ends_with('s'))
}

/// Returns the position (`x`, `y`) in the coordinate system `source`.
fn locate(source: &Proj, target: &Proj, x: f64, y: f64, altitude: Option<f64>) -> Option<GeoPosition> {
    let mut point = match source.is_latlong() {
        true => (x.to_radians(), y.to_radians(), 0.),
        false => (x, y, 0.),
    };
    transform(source, target, &mut point).ok()?;
    GeoPosition::new(point.0.to_degrees(), point.1.to_degrees(), altitude)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(text: &str) -> Result<BTreeMap<String, GeoPosition>> {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join(GEO_FILE);
        std::fs::write(&file, text).unwrap();
        read_geo_positions(&file)
    }

    #[test]
    fn coordinate_systems_agree() {
        // The CN Tower, whose UTM coordinates are an example of the article on UTM in Wikipedia: 17N 630084 4833438.
        let tower = [-79.387139, 43.642567];
        for system in
            ["EPSG:32617", "epsg: 32617", "WGS84 UTM 17N", "+proj=utm +zone=17 +datum=WGS84 +units=m"]
        {
            let found = read(&format!("{system}\n# comment\n\na.jpg 630084 4833438 76.5 0 0 0\r\n")).unwrap()
                ["a.jpg"];
            // 1 m is 9e-6 degrees of latitude.
            assert!(
                (found.longitude - tower[0]).abs() < 1.3e-5 && (found.latitude - tower[1]).abs() < 9e-6,
                "{found:?}"
            );
            assert_eq!(found.altitude, Some(76.5));
        }
        let south = read("EPSG:32756\na.jpg 334873 6252266").unwrap()["a.jpg"];
        // The Sydney Opera House.
        assert!(
            (south.longitude - 151.2153).abs() < 1e-3 && (south.latitude + 33.8568).abs() < 1e-3,
            "{south:?}"
        );
        for system in ["EPSG:4326", "+proj=longlat +datum=WGS84"] {
            let found = read(&format!("{system}\na.jpg {} {}", tower[0], tower[1])).unwrap()["a.jpg"];
            assert!((found.longitude - tower[0]).abs() < 1e-12 && (found.latitude - tower[1]).abs() < 1e-12);
            assert_eq!(found.altitude, None);
        }
    }

    #[test]
    fn bad_lines_are_refused_by_their_number() {
        for (text, expected) in [
            ("", "the coordinate system in line 1 is \"\", expected EPSG:4326, EPSG:326zz"),
            ("EPSG:32661\n", "the coordinate system in line 1 is \"EPSG:32661\""),
            (
                "EPSG:4326\na.jpg 7 48\n\nb.jpg 7\n",
                "the position in line 4 is \"b.jpg 7\", expected a photo's name",
            ),
            ("EPSG:4326\na.jpg 7 95\n", "the position in line 2 is"),
            ("EPSG:4326\na.jpg 7 x\n", "the position in line 2 is"),
            ("EPSG:4326\na.jpg 7 48 nan\n", "the position in line 2 is"),
            (
                "EPSG:4326\na.jpg 7 48\na.jpg 7 48\n",
                "the name in line 3 is \"a.jpg\", expected each name once",
            ),
        ] {
            let error = read(text).unwrap_err().to_string();
            assert!(error.contains(expected), "{text:?}: {error}");
        }
    }

    #[test]
    fn local_coordinates_are_metres() {
        let position =
            |longitude: f64, latitude: f64, altitude| Some(GeoPosition { longitude, latitude, altitude });
        let local = to_east_north_up(&[
            None,
            position(8., 50., Some(100.)),
            position(8., 50.001, Some(110.)),
            position(8.001, 50., None),
        ]);
        assert_eq!(local[0], None);
        // A minute of latitude is 1853.7 m at 50°, and one of longitude cos 50° · 1859.0 m; the mean altitude is 105 m.
        let expected = [DVec3::NEG_Z * 5., DVec3::new(0., 111.23, 5.), DVec3::new(71.7, 0., 0.)];
        for (found, expected) in local[1..].iter().zip(expected) {
            assert!(found.unwrap().abs_diff_eq(expected, 0.05), "{found:?} {expected}");
        }
        assert_eq!(to_east_north_up(&[None, None]), [None, None]);
    }
}
