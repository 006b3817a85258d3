//! Options that edit a splat, in the order in which they are given.

use super::open_capture;
use crate::error::Error;
use crate::io::{InputFiles, read_splat_without_invalid, splat_files};
use crate::render::SplatEdit;
use crate::scene::Camera;
use clap::{Arg, ArgAction, ArgMatches, Args, Command, FromArgMatches};
use glam::{DMat4, DQuat, DVec3};
use std::f64::consts::{FRAC_PI_2, PI};
use std::path::PathBuf;

/// Edit as it is given, before files are read.
#[derive(Debug, Clone)]
enum EditArgument {
    Edit(SplatEdit),
    Upright,
    /// Values of `--length`, each its numbers.
    Length(Vec<Vec<f64>>),
    PruneUnseen(PathBuf),
    Merge(PathBuf),
}

impl EditArgument {
    /// Returns the values of both arguments, if these are a length's, or else the second argument.
    fn joined(self, other: Self) -> Self {
        match (self, other) {
            (EditArgument::Length(first), EditArgument::Length(second)) => {
                EditArgument::Length([first, second].concat())
            }
            (_, other) => other,
        }
    }
}

/// Name of every option, name of its value, and help.
const OPTIONS: [(&str, &str, &str); 15] = [
    ("scale", "FACTOR", "Scale about the world's origin"),
    ("rotate", "X,Y,Z", "Rotate about the world's x axis, then its y axis, then its z axis, in degrees"),
    ("translate", "X,Y,Z", "Move by a vector"),
    (
        "matrix",
        "NUMBERS",
        "Multiply by a matrix of 4×4 numbers, row by row, which rotates, scales uniformly and translates",
    ),
    (
        "up",
        "AXIS",
        "Rotate a splat whose axis x, y, z, -x, -y or -z points up, so that -y does, as 3DGS and most viewers have it",
    ),
    (
        "upright",
        "",
        "Rotate so that -y points up, with the floor at y = 0 and the cameras' center at x = z = 0, by the cameras of --scene and the splat",
    ),
    (
        "length",
        "X,Y,Z X,Y,Z METRES",
        "Scale about the world's origin so that the distance between two points is METRES; the page of `view` measures points",
    ),
    (
        "crop-box",
        "X,Y,Z,X,Y,Z",
        "Keep the Gaussians whose centers are in the box between two corners; - stands for no bound",
    ),
    ("crop-sphere", "X,Y,Z,RADIUS", "Keep the Gaussians whose centers are in a sphere"),
    ("min-opacity", "OPACITY", "Remove Gaussians of a lower opacity, 0 to 1"),
    ("max-scale", "LENGTH", "Remove Gaussians with a larger standard deviation along any of their axes"),
    (
        "filter-floaters",
        "FACTOR",
        "Remove isolated Gaussians: those whose eighth neighbour is FACTOR times as far as is usual, 10 by default, and beyond \
         their own size",
    ),
    (
        "prune-unseen",
        "SCENE",
        "Remove Gaussians that no camera of this capture sees: those that contribute less than a thousandth of a pixel to all views \
         together",
    ),
    (
        "decimate",
        "N",
        "Keep N Gaussians: those that contribute most to the views of --scene, or to eight views around the splat",
    ),
    ("merge", "FILE", "Add the Gaussians of another splat"),
];

/// Parses the value of the option `name`.
fn parse(name: &str, text: &str) -> Result<EditArgument, String> {
    let transform = |matrix| Ok(EditArgument::Edit(SplatEdit::Transform(matrix)));
    let edit = match name {
        "scale" => return transform(DMat4::from_scale(DVec3::splat(positive(text)?))),
        "rotate" => {
            let [x, y, z] = numbers(text)?.map(f64::to_radians);
            return transform(
                DMat4::from_rotation_z(z) * DMat4::from_rotation_y(y) * DMat4::from_rotation_x(x),
            );
        }
        "translate" => return transform(DMat4::from_translation(DVec3::from(numbers(text)?))),
        "matrix" => return transform(DMat4::from_cols_array(&numbers(text)?).transpose()),
        "up" => return transform(DMat4::from_quat(rotation_from_up(text)?)),
        "crop-box" => parse_box(text)?,
        "crop-sphere" => match numbers(text)? {
            [x, y, z, radius] if radius > 0. => SplatEdit::CropSphere(DVec3::new(x, y, z), radius),
            _ => return Err("expected a radius above 0".into()),
        },
        "min-opacity" => match numbers(text)? {
            [opacity] if (0. ..=1.).contains(&opacity) => SplatEdit::MinOpacity(opacity),
            _ => return Err("expected a number from 0 to 1".into()),
        },
        "max-scale" => SplatEdit::MaxScale(positive(text)?),
        "filter-floaters" => SplatEdit::FilterFloaters(positive(text)?),
        "decimate" => match text.parse() {
            Ok(0) | Err(_) => return Err("expected a number of Gaussians, 1 or more".into()),
            Ok(count) => SplatEdit::Decimate(count),
        },
        "upright" => return Ok(EditArgument::Upright),
        "length" => {
            let point = numbers::<3>(text).map(Vec::from);
            let number = point.or_else(|_| Ok::<_, String>(vec![positive(text)?]));
            let expected = "expected two points as 1,2,3 and the distance between them, above 0";
            return number.map(|numbers| EditArgument::Length(vec![numbers])).map_err(|_| expected.into());
        }
        "prune-unseen" => return Ok(EditArgument::PruneUnseen(text.into())),
        "merge" => return Ok(EditArgument::Merge(text.into())),
        other => unreachable!("{other} is no option"),
    };
    Ok(EditArgument::Edit(edit))
}

/// Parses `N` finite numbers that are separated by commas.
fn numbers<const N: usize>(text: &str) -> Result<[f64; N], String> {
    let numbers: Option<Vec<f64>> = text
        .split(',')
        .map(|part| part.trim().parse().ok().filter(|number: &f64| number.is_finite()))
        .collect();
    let expected = || match N {
        1 => "expected a number".into(),
        _ => format!("expected {N} numbers with commas between them"),
    };
    numbers.and_then(|numbers| numbers.try_into().ok()).ok_or_else(expected)
}

fn positive(text: &str) -> Result<f64, String> {
    match numbers(text) {
        Ok([number]) if number > 0. => Ok(number),
        _ => Err("expected a number above 0".into()),
    }
}

/// Parses a box, where - stands for no bound, as for splat-transform.
fn parse_box(text: &str) -> Result<SplatEdit, String> {
    let bounds: Vec<&str> = text.split(',').map(str::trim).collect();
    let ([first, second], []) = bounds.as_chunks::<3>() else {
        return Err("expected 6 numbers with commas between them, or - where there is no bound".into());
    };
    let corner = |bounds: &[&str; 3], unbounded: f64| -> Result<DVec3, String> {
        let bound = |text: &&str| if *text == "-" { Ok([unbounded]) } else { numbers(text) };
        let bounds = bounds.iter().map(|text| Ok(bound(text)?[0])).collect::<Result<Vec<f64>, String>>()?;
        Ok(DVec3::from_slice(&bounds))
    };
    let (low, high) = (corner(first, f64::NEG_INFINITY)?, corner(second, f64::INFINITY)?);
    Ok(SplatEdit::CropBox(low.min(high), low.max(high)))
}

/// Returns the scale with which the distance between two points is a length, from the values of `--length`.
fn scale_to_length(values: &[Vec<f64>]) -> Result<SplatEdit, String> {
    let [[ax, ay, az], [bx, by, bz], [length]] = values.iter().map(Vec::as_slice).collect::<Vec<_>>()[..]
    else {
        return Err("expected two points as 1,2,3 and the distance between them".into());
    };
    let distance = DVec3::new(*ax, *ay, *az).distance(DVec3::new(*bx, *by, *bz));
    match length / distance {
        scale if scale > 0. && scale.is_finite() => {
            Ok(SplatEdit::Transform(DMat4::from_scale(DVec3::splat(scale))))
        }
        _ => Err("expected two points that differ".into()),
    }
}

/// Returns the rotation with which the axis `up` becomes -y.
fn rotation_from_up(up: &str) -> Result<DQuat, String> {
    Ok(match &up.to_lowercase()[..] {
        "x" => DQuat::from_rotation_z(-FRAC_PI_2),
        "-x" => DQuat::from_rotation_z(FRAC_PI_2),
        "y" => DQuat::from_rotation_x(PI),
        "-y" => DQuat::IDENTITY,
        "z" => DQuat::from_rotation_x(FRAC_PI_2),
        "-z" => DQuat::from_rotation_x(-FRAC_PI_2),
        _ => return Err("expected x, y, z, -x, -y or -z".into()),
    })
}

/// Edits in the order in which they are given, each with its option as it is given.
#[derive(Debug)]
pub struct Edits(Vec<(String, EditArgument)>);

impl Edits {
    /// Reads the files of the edits, and returns each edit with its option. `cameras` are those of `--scene`. The files are added to `inputs`;
    /// `warn` receives the warnings of the splats that are read.
    pub fn read(
        &self,
        cameras: Option<Vec<Camera>>,
        inputs: &mut InputFiles,
        warn: impl Fn(&[String]),
    ) -> crate::Result<Vec<(&str, SplatEdit)>> {
        let mut read = |option: &str, argument: &EditArgument| -> crate::Result<SplatEdit> {
            Ok(match argument {
                EditArgument::Edit(edit) => edit.clone(),
                EditArgument::Length(values) => {
                    scale_to_length(values).map_err(|why| Error::request(format!("{option}: {why}")))?
                }
                EditArgument::Upright => SplatEdit::Upright(
                    cameras
                        .clone()
                        .ok_or_else(|| Error::request("--upright needs the cameras of --scene"))?,
                ),
                EditArgument::PruneUnseen(path) => {
                    let capture = open_capture(path)?;
                    capture.add_input_files(inputs);
                    SplatEdit::SeenBy(capture.cameras())
                }
                EditArgument::Merge(path) => {
                    splat_files(path).iter().for_each(|file| inputs.add(file));
                    let splat = read_splat_without_invalid(path)?;
                    warn(&splat.warnings);
                    SplatEdit::Merge(Box::new(splat))
                }
            })
        };
        self.0.iter().map(|(option, argument)| Ok((&option[..], read(option, argument)?))).collect()
    }
}

impl Args for Edits {
    fn augment_args(command: Command) -> Command {
        let argument = |(name, value, help): (&'static str, &'static str, &'static str)| {
            let argument = Arg::new(name)
                .long(name)
                .value_name(value)
                .help(help)
                .help_heading("Edits, applied in the order in which they are given")
                .action(ArgAction::Append)
                // Paths that begin with a hyphen are rare, and a forgotten value isn't the next option.
                .allow_hyphen_values(!["merge", "prune-unseen"].contains(&name))
                .value_parser(move |text: &str| {
                    parse(name, text).map(|argument| (text.to_owned(), argument))
                });
            match name {
                "upright" => argument.num_args(0).default_missing_value(""),
                "length" => argument.num_args(3).value_names(["X,Y,Z", "X,Y,Z", "METRES"]),
                "filter-floaters" => {
                    argument.num_args(0..=1).require_equals(true).default_missing_value("10")
                }
                _ => argument,
            }
        };
        command.args(OPTIONS.map(argument))
    }

    fn augment_args_for_update(command: Command) -> Command {
        Self::augment_args(command)
    }
}

impl FromArgMatches for Edits {
    fn from_arg_matches(matches: &ArgMatches) -> Result<Self, clap::Error> {
        let mut edits = vec![];
        for (name, ..) in OPTIONS {
            let groups = matches.get_occurrences::<(String, EditArgument)>(name).into_iter().flatten();
            let mut places = matches.indices_of(name).into_iter().flatten();
            for group in groups {
                let (texts, arguments): (Vec<&str>, Vec<EditArgument>) =
                    group.map(|(text, argument)| (&text[..], argument.clone())).unzip();
                let place = places.nth(texts.len() - 1);
                let argument = arguments.into_iter().reduce(EditArgument::joined).expect("a value");
                let text = match &texts.join(" ")[..] {
                    "" => format!("--{name}"),
                    text => format!("--{name}={text}"),
                };
                edits.push((place, (text, argument)));
            }
        }
        edits.sort_by_key(|(place, _)| *place);
        Ok(Edits(edits.into_iter().map(|(_, edit)| edit).collect()))
    }

    fn update_from_arg_matches(&mut self, matches: &ArgMatches) -> Result<(), clap::Error> {
        *self = Self::from_arg_matches(matches)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::Parser;

    #[derive(Parser)]
    struct Program {
        #[command(flatten)]
        edits: Edits,
    }

    #[test]
    fn edits_are_in_the_order_of_the_options() {
        let arguments = "x --translate -1,2,3 --scale 2 --filter-floaters --translate 4,5,6 --up -z --length -1,0,0 1,0,0 4 \
                         --upright --crop-sphere 0,0,0,1";
        let program = Program::try_parse_from(arguments.split_whitespace()).unwrap();
        let edits = program.edits.read(Some(vec![]), &mut InputFiles::default(), |_| ()).unwrap();
        let options: Vec<_> = edits.iter().map(|(option, _)| *option).collect();
        let expected = [
            "--translate=-1,2,3",
            "--scale=2",
            "--filter-floaters=10",
            "--translate=4,5,6",
            "--up=-z",
            "--length=-1,0,0 1,0,0 4",
            "--upright",
            "--crop-sphere=0,0,0,1",
        ];
        assert_eq!(options, expected);
        let SplatEdit::Transform(matrix) = edits[5].1 else { panic!() };
        assert_eq!(matrix, DMat4::from_scale(DVec3::splat(2.)));
        let error = program.edits.read(None, &mut InputFiles::default(), |_| ()).unwrap_err();
        assert_eq!(error.to_string(), "--upright needs the cameras of --scene");
        let SplatEdit::CropBox(low, high) = parse_box("-,1,-,2,-,3").unwrap() else { panic!() };
        assert_eq!((low.y, high.x, high.z), (1., 2., 3.));
        assert!(low.x == f64::NEG_INFINITY && low.z == f64::NEG_INFINITY && high.y == f64::INFINITY);
        for (up, axis) in [("x", DVec3::X), ("y", DVec3::Y), ("z", DVec3::Z)] {
            for (up, axis) in [(up.to_string(), axis), (format!("-{up}"), -axis)] {
                let rotated = rotation_from_up(&up).unwrap() * axis;
                assert!(rotated.abs_diff_eq(DVec3::NEG_Y, 1e-12), "{up}: {rotated}");
            }
        }
    }

    #[test]
    fn bad_values_are_refused() {
        for (arguments, message) in [
            ("--scale 0", "expected a number above 0"),
            ("--scale nan", "expected a number above 0"),
            ("--translate 1,2", "expected 3 numbers with commas"),
            ("--crop-box 1,2,3,4,5,x", "expected a number"),
            ("--crop-box 1,2,3", "expected 6 numbers"),
            ("--crop-sphere 0,0,0,-1", "a radius above 0"),
            ("--min-opacity 1.5", "from 0 to 1"),
            ("--decimate 0", "1 or more"),
            ("--length 1,2,3 1,2,4 0", "and the distance between them, above 0"),
            ("--up w", "expected x, y, z, -x, -y or -z"),
        ] {
            let error =
                Program::try_parse_from(std::iter::once("x").chain(arguments.split(' '))).err().unwrap();
            assert!(error.to_string().contains(message), "{arguments}: {error}");
        }
        for (values, message) in [
            ("1,2,3 1,2,3 4", "expected two points that differ"),
            ("1,2,3 4 1,2,4", "expected two points as 1,2,3"),
        ] {
            let arguments = format!("x --length {values}");
            let edits = Program::try_parse_from(arguments.split(' ')).unwrap().edits;
            let error = edits.read(None, &mut InputFiles::default(), |_| ()).unwrap_err().to_string();
            assert!(error.starts_with(&format!("--length={values}: {message}")), "{error}");
        }
    }
}
