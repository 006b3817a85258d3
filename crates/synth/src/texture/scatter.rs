//! Textures of many scattered small objects: leaves, grass, gravel, chips, flowers.

use glam::{Vec2, Vec3};

use super::canvas::{Shape, coverage, smoothstep};
use super::noise::{Random, fractal};
use super::palette::*;
use super::{Canvas, Purpose, SIZE, Surface};

/// Draws ground of one theme, dark enough to lie below other objects.
fn ground(random: &Random, theme: Theme) -> Canvas {
    let palette = Palette::from_theme(random, theme, 2);
    let field = fractal(random, SIZE, [random.count(2, 12); 2], 6, 0.75);
    let dark = random.uniform(0.35, 1.);
    let mut canvas = field.map(|value| palette.ramp(0.5 + 0.5 * value) * dark);
    canvas.shade(&field, 0.15);
    canvas
}

/// Draws overlapping leaves, the upper ones brighter.
pub(super) fn leaves(random: &Random, purpose: Purpose) -> Surface {
    let fallen = !matches!(purpose, Purpose::Foliage) && random.chance(0.5);
    let theme = if fallen { AUTUMN } else { random.weighted(&[(GREENS, 6.), (AUTUMN, 1.)]) };
    let mut canvas = ground(random, if fallen { EARTHS } else { theme });
    if !fallen {
        canvas.update(|_, pixel| pixel * 0.35);
    }
    let palette = Palette::from_theme(random, theme, 4);
    let length = random.sqrt_uniform(0.025, 0.16);
    let slim = random.uniform(0.25, 0.9);
    let cover = if fallen { random.uniform(0.2, 1.6) } else { random.uniform(1.2, 2.6) };
    let count = (cover / (length * length * slim * 0.5)) as usize;
    let count = count.min(2600);
    let veined = random.uniform(0., 0.35);
    let lit = random.uniform(0.3, 0.9);
    for index in 0..count {
        let height = index as f32 / count as f32;
        let light = if fallen {
            random.uniform(0.7, 1.2)
        } else {
            1.15 - lit * (1. - height) + 0.2 * random.approx_normal()
        };
        let color = palette.ramp(random.unit()) * light.max(0.1);
        let turn = random.direction();
        let size = length * random.uniform(0.6, 1.3);
        let width = size * slim * random.uniform(0.6, 1.1);
        let tilt = random.uniform(-0.35, 0.35);
        let pixels = SIZE as f32;
        let leaf = Shape::leaf(size, width);
        canvas.stamp(random.point(), Vec2::splat(0.55 * size), |offset| {
            let local = turn.rotate(offset);
            let vein = 1. + veined * (1. - local.y.abs() * pixels).max(0.);
            let side = 1. + tilt * local.y.signum() * (local.y.abs() * pixels).min(1.) + 0.3 * local.x / size;
            (color * vein * side, leaf.distance(local))
        });
    }
    Surface { canvas, repeat_metres: random.uniform(0.06, 0.15) / length * 0.6 }
}

/// Draws blades of grass, needles or straw.
pub(super) fn grass(random: &Random, _: Purpose) -> Surface {
    let theme = random.weighted(&[(GREENS, 6.), (AUTUMN, 1.5), (EARTHS, 0.5)]);
    let mut canvas = ground(random, random.one_of(&[EARTHS, theme]));
    let palette = Palette::from_theme(random, theme, 4);
    let patches = fractal(random, SIZE, [3; 2], 4, 0.6);
    let bare = random.uniform(-1.5, 0.3);
    let length = random.sqrt_uniform(0.025, 0.11);
    let width = random.uniform(0.4, 1.2) / SIZE as f32;
    let upright = random.uniform(0., 0.9);
    let count = (random.uniform(50., 110.) / length) as usize;
    let dry = random_theme_color(random, AUTUMN);
    let dryness = random.sqrt_uniform(0., 0.4);
    for _ in 0..count {
        let root = random.point();
        let patch = patches.sample(root);
        let lean = random.direction() * (1. - upright) - Vec2::Y * upright;
        let half = lean * 0.5 * length * random.uniform(0.4, 1.2);
        let light = random.uniform(0.45, 1.25) * (1. + 0.2 * patch);
        let green = if random.chance(dryness) { dry } else { palette.ramp(random.unit()) };
        if patch < bare {
            continue;
        }
        canvas.fill(root, &Shape::stroke(-half, half, width), green * light);
    }
    if random.chance(0.2) {
        let petals = [VIVID, WHITES, ACCENTS].map(|theme| random_theme_color(random, theme));
        for _ in 0..random.count(10, 150) {
            let radius = random.uniform(1., 3.) / SIZE as f32;
            let color = random.one_of(&petals);
            canvas.fill(random.point(), &Shape::disk(radius), color);
        }
    }
    Surface { canvas, repeat_metres: random.uniform(0.8, 3.) }
}

/// Draws pebbles, gravel, bark or rubble: rounded bits with a lit side and a shadow.
pub(super) fn gravel(random: &Random, _: Purpose) -> Surface {
    let theme = random.weighted(&[(STONES, 5.), (EARTHS, 2.), (GRAYS, 2.), (BROWNS, 1.), (WHITES, 0.5)]);
    let mut canvas = ground(random, random.one_of(&[EARTHS, theme]));
    let palette = Palette::from_theme(random, theme, 4);
    let radius = random.sqrt_uniform(0.008, 0.06);
    let cover = random.uniform(0.4, 1.4);
    let count = ((cover / (3. * radius * radius)) as usize).min(3000);
    let angular = random.chance(0.4);
    let (light, strength) = (random.direction(), random.uniform(0.15, 0.7));
    let shadow = random.uniform(0., 0.7);
    let flat = random.uniform(0.5, 1.);
    let spread = random.uniform(0.1, 0.6);
    for _ in 0..count {
        let center = random.point();
        let size = radius * random.sqrt_uniform(0.35, 1.5);
        let radii = Vec2::new(size, size * random.uniform(flat, 1.));
        let turn = random.direction();
        let tone = palette.ramp(random.unit()) * (1. + spread * random.approx_normal()).max(0.2);
        let corners = random.count(3, 6);
        let outline = match angular {
            true => Shape::polygon(0.75 * size, corners),
            false => Shape::disk(size),
        };
        let distance = |offset: Vec2| outline.distance(turn.rotate(offset) * size / radii);
        let reach = Vec2::splat(1.5 * size);
        canvas.blend(center - light * 0.35 * size, reach, |offset| {
            (Vec3::splat(0.01), shadow * coverage(distance(offset), 0.5 * SIZE as f32))
        });
        canvas.stamp(center, reach, |offset| {
            let lit = 1. + strength * offset.dot(light) / size;
            (tone * lit.max(0.1), distance(offset))
        });
    }
    Surface { canvas, repeat_metres: random.uniform(0.008, 0.05) / radius }
}

/// Draws earth or sand, with tracks, clods and some green.
pub(super) fn earth(random: &Random, _: Purpose) -> Surface {
    let mut canvas = ground(random, random.weighted(&[(EARTHS, 5.), (BEIGES, 1.5), (BROWNS, 1.)]));
    let cells = random.sqrt_uniform(4., 32.) as usize;
    let stretch = random.one_of(&[[1, 1], [1, 1], [1, 3]]);
    let clods = fractal(random, SIZE, stretch.map(|factor| cells * factor), 5, 0.8);
    canvas.shade(&clods.slope(random.direction()), random.uniform(0.2, 1.2));
    if random.chance(0.5) {
        let green = Palette::from_theme(random, GREENS, 2);
        let patches = fractal(random, SIZE, [3; 2], 6, 0.75);
        let level = random.uniform(-0.4, 1.);
        canvas.update_with(&patches, |pixel, value| {
            pixel.lerp(green.ramp(0.5 + 0.5 * value), 0.9 * smoothstep(level, level + 0.5, value))
        });
    }
    Surface { canvas, repeat_metres: random.uniform(1., 4.) }
}

/// Draws confetti, splashes or brush strokes: bits of any shape in several colors.
pub(super) fn confetti(random: &Random, purpose: Purpose) -> Surface {
    let palette = Palette::draw(random, purpose, random.count(3, 5));
    let mut canvas = Canvas::filled(SIZE, palette.color(0));
    let length = random.sqrt_uniform(0.02, 0.3);
    let bits = (random.uniform(0.2, 2.) / (length * length)).min(800.) as usize;
    let kind = random.count(0, 3);
    let slim = random.uniform(0.05, 0.6);
    let clear = random.uniform(0.4, 1.);
    for _ in 0..bits {
        let color = palette.any(random);
        let turn = random.direction();
        let size = length * random.uniform(0.3, 1.2);
        let bit = match kind {
            0 => Shape::ellipse(Vec2::new(0.5, 0.5 * slim + 0.1) * size),
            1 => Shape::rectangle(Vec2::new(0.5, 0.5 * slim) * size, 0.),
            2 => Shape::polygon(0.3 * size, 3),
            _ => Shape::flower(0.5 * size, 5, slim),
        };
        let bit = bit.turned(turn);
        canvas.blend(random.point(), Vec2::splat(0.8 * size), |offset| {
            (color, clear * coverage(bit.distance(offset), SIZE as f32))
        });
    }
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.4, 3.) }
}
