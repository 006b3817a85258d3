//! Pictures for walls and sills: paintings, prints, photos, signs. One repeat is the whole picture.

use glam::{Vec2, Vec3};

use super::canvas::{Shape, coverage, smoothstep};
use super::marks::{Script, ink_for, paper};
use super::noise::{Random, fractal, smooth};
use super::palette::*;
use super::{Canvas, Purpose, Surface};

/// Width in pixels, larger than that of other textures because nothing repeats within a picture.
const SIZE: usize = 512;

/// Draws a picture of a random kind, often with a mat or a frame.
pub(super) fn picture(random: &Random) -> Surface {
    let kind: fn(&Random) -> Canvas = random.weighted(&[
        (landscape as _, 3.),
        (portrait as _, 1.5),
        (window as _, 2.),
        (shapes as _, 2.),
        (print as _, 2.),
        (painting as _, 2.),
        (dead_leaves as _, 2.),
        (flowers as _, 1.),
        (screen as _, 1.),
    ]);
    let mut canvas = kind(random);
    if random.chance(0.55) {
        frame(random, &mut canvas);
    }
    Surface { canvas, repeat_metres: random.sqrt_uniform(0.25, 1.4) }
}

/// Draws a landscape: sky over hills, water or roofs.
fn landscape(random: &Random) -> Canvas {
    let skies = [
        [0x5f93c9, 0xd6e4ee],
        [0x8fa5b5, 0xe3e0d8],
        [0x2e3f66, 0xe0946a],
        [0xb9a58a, 0xeee2c8],
        [0x22304a, 0x6d87a0],
    ];
    let [zenith, haze] = random.one_of(&skies).map(srgb_to_linear).map(|color| shade(random, color, 0.2));
    let clouds = fractal(random, SIZE, [2, 5], 7, 0.6);
    let (level, cover) = (random.uniform(-0.5, 1.), random.uniform(0., 0.9));
    let horizon = random.uniform(0.35, 0.75);
    let mut canvas = Canvas::from_fn(SIZE, |uv| {
        let sky = zenith.lerp(haze, (uv.y / horizon).min(1.));
        let cloud = cover * smoothstep(level, level + 0.8, clouds.value(uv));
        sky.lerp(Vec3::splat(0.85).lerp(haze, 0.3), cloud)
    })
    .without_wrapping();
    if random.chance(0.4) {
        let (sun, radius) = (Vec2::new(random.unit(), horizon * random.unit()), random.uniform(0.02, 0.09));
        canvas.fill(sun, &Shape::disk(radius), haze.lerp(Vec3::ONE, 0.7));
    }
    let theme = random.weighted(&[(GREENS, 4.), (AUTUMN, 2.), (ACCENTS, 1.), (STONES, 1.)]);
    let ranges = random.count(2, 6);
    for range in 0..ranges {
        let near = (range + 1) as f32 / ranges as f32;
        let (hills, jagged) = (random.count(1, 4), random.uniform(0.3, 0.65));
        let profile = fractal(random, SIZE, [hills, 1], 6, jagged);
        let ground = random_theme_color(random, theme).lerp(haze, 0.75 * (1. - near));
        let water = random.chance(0.12);
        let texture = fractal(random, SIZE, [4, 16], 5, 0.8);
        let base = horizon + (1. - horizon) * (near - 0.5 / ranges as f32) * 0.8;
        let height = if water { 0. } else { random.uniform(0.03, 0.18) };
        canvas.update(|uv, below| {
            let top = base - height * (1. + profile.values[(uv.x * SIZE as f32) as usize]);
            let value = texture.value(uv);
            let color = if water {
                zenith.lerp(haze, 0.5 + 0.3 * value)
            } else {
                ground * (1. + 0.35 * near * value)
            };
            below.lerp(color, coverage(top - uv.y, SIZE as f32))
        });
        if !water && random.chance(0.5) {
            for _ in 0..random.count(2, 40) {
                let x = random.unit();
                let size = near * random.uniform(0.01, 0.07);
                let top = base - height * (1. + profile.values[((x * SIZE as f32) as usize).min(SIZE - 1)]);
                let color = ground * random.uniform(0.3, 0.9);
                let slim = random.uniform(0.4, 1.);
                let crown = Shape::flower(size, random.count(3, 9), 0.25);
                let (place, squeeze) = (Vec2::new(x, top - 0.3 * size), Vec2::new(slim, 1.));
                let reach = Vec2::splat(1.2 * size);
                canvas.stamp(place, reach, |offset| (color, crown.distance(offset / squeeze)));
            }
        }
    }
    canvas
}

/// Draws a portrait: shoulders, neck, head, hair, face.
fn portrait(random: &Random) -> Canvas {
    let backdrop = Palette::draw(random, Purpose::Poster, 2);
    let drift = smooth(random, SIZE, [2, 2]);
    let backdrop = |uv: Vec2| backdrop.ramp(0.3 * uv.y + 0.35 + 0.3 * drift.value(uv)) * 0.7;
    let mut canvas = Canvas::from_fn(SIZE, backdrop).without_wrapping();
    let skins = [0xe6b998, 0xc98f6b, 0x8d5a3c, 0x5c3a28, 0xf0d0b8];
    let skin = shade(random, srgb_to_linear(random.one_of(&skins)), 0.1);
    let hair = random_theme_color(random, BROWNS) * random.uniform(0.2, 1.);
    let cloth = random_color_of_themes(random, &[(ACCENTS, 3.), (GRAYS, 2.), (VIVID, 1.)]);
    for _ in 0..random.one_of(&[1, 1, 1, 2, 3]) {
        let head = Vec2::new(random.uniform(0.3, 0.7), random.uniform(0.3, 0.5));
        let size = random.uniform(0.1, 0.24);
        let light = Vec2::new(random.uniform(-1., 1.), -0.4);
        let mut blob = |place: Vec2, radii: Vec2, color: Vec3, shading: f32| {
            let (place, radii) = (place * size, radii * size);
            let ellipse = Shape::ellipse(radii);
            canvas.stamp(head + place, radii + 0.004, |offset| {
                let lit = 1. + shading * (offset / radii).dot(light);
                (color * lit.max(0.2), ellipse.distance(offset))
            });
        };
        let long = random.uniform(0., 1.);
        blob(Vec2::new(0., 0.25 * long - 0.15), Vec2::new(1., 1.2 + 0.5 * long), hair, 0.3);
        blob(Vec2::new(0., 3.1), Vec2::new(2.2, 1.8), cloth, 0.35);
        blob(Vec2::new(0., 1.2), Vec2::new(0.38, 0.7), skin * 0.8, 0.3);
        blob(Vec2::ZERO, Vec2::new(0.78, 1.), skin, 0.35);
        blob(Vec2::new(0., -0.8), Vec2::new(0.75, 0.4), hair, 0.3);
        for side in [-1., 1.] {
            blob(Vec2::new(0.32 * side, -0.1), Vec2::new(0.14, 0.07), Vec3::splat(0.7), 0.);
            blob(Vec2::new(0.32 * side, -0.1), Vec2::splat(0.06), Vec3::splat(0.03), 0.);
            blob(Vec2::new(0.33 * side, -0.27), Vec2::new(0.18, 0.04), hair * 0.7, 0.);
        }
        blob(Vec2::new(0.05, 0.18), Vec2::new(0.08, 0.2), skin * 0.85, 0.4);
        blob(Vec2::new(0., 0.52), Vec2::new(0.25, 0.07), skin * Vec3::new(0.8, 0.4, 0.4), 0.1);
    }
    canvas
}

/// Draws an abstract picture of large flat shapes.
fn shapes(random: &Random) -> Canvas {
    let palette = Palette::draw(random, Purpose::Poster, random.count(3, 5));
    let mut canvas = Canvas::filled(SIZE, palette.color(0)).without_wrapping();
    let straight = random.chance(0.4);
    let line = if random.chance(0.4) { random.uniform(0.003, 0.015) } else { 0. };
    for _ in 0..random.count(3, 40) {
        let size = random.sqrt_uniform(0.03, 0.45);
        let half = Vec2::new(1., random.uniform(0.1, 1.)) * size;
        let turn = if straight { random.one_of(&[Vec2::X, Vec2::Y]) } else { random.direction() };
        let (kind, corners, depth) = (random.count(0, 4), random.count(3, 6), random.uniform(0., 0.7));
        let shape = match kind {
            0 => Shape::disk(size),
            1 => Shape::polygon(0.6 * size, corners),
            2 => Shape::flower(size, corners, depth),
            // Half a disk.
            3 => Shape::new(Vec2::splat(size), move |offset| (offset.length() - size).max(offset.y)),
            _ => Shape::rectangle(half, 0.),
        };
        let shape = shape.turned(turn);
        let (center, reach) = (random.point(), Vec2::splat(1.42 * size));
        let color = palette.any(random);
        canvas.stamp(center, reach, |offset| (color, shape.distance(offset)));
        if line > 0. {
            let black = Vec3::splat(0.02);
            canvas.stamp(center, reach, |offset| (black, shape.distance(offset).abs() - line));
        }
    }
    canvas
}

/// Draws a poster or a sign: a heading, a picture, paragraphs.
fn print(random: &Random) -> Canvas {
    let paper = paper(random, Purpose::Poster, 0.5);
    let mut canvas = Canvas::filled(SIZE, paper).without_wrapping();
    let ink = ink_for(random, paper);
    let script = Script::draw(random);
    let mut top = 0.06;
    while top < 0.9 {
        let left = 0.94 - top;
        match random.count(0, 3) {
            0 => {
                let height = random.sqrt_uniform(0.05, 0.3).min(left);
                let start = Vec2::new(0.07, top + 0.5 * height);
                script.write(random, &mut canvas, start, 0.88, 0.8 * height, ink);
                top += height;
            }
            1 => {
                let height = random.uniform(0.15, 0.6).min(left);
                let inner = random.one_of(&[landscape, shapes, portrait, dead_leaves])(random);
                let (low, extent) = (Vec2::new(0.06, top), Vec2::new(0.88, height));
                canvas.update(|uv, below| {
                    let at = (uv - low) / extent;
                    let inside = at.cmpge(Vec2::ZERO).all() && at.cmplt(Vec2::ONE).all();
                    // Crop instead of squeezing, keeping the aspect ratio.
                    if inside { inner.sample(Vec2::new(at.x, (at.y - 0.5) * height + 0.5)) } else { below }
                });
                top += height + 0.03;
            }
            2 => {
                let height = random.uniform(0.1, 0.4).min(left);
                let letters = random.sqrt_uniform(0.014, 0.05);
                let (corner, extent) = (Vec2::new(0.07, top), Vec2::new(0.86, height));
                script.paragraph(random, &mut canvas, corner, extent, letters, ink);
                top += height + 0.02;
            }
            _ => {
                let height = random.uniform(0.03, 0.2).min(left);
                let color = Palette::draw(random, Purpose::Poster, 1).color(0);
                let half = Vec2::new(random.one_of(&[0.5, 0.43, 0.2]), 0.5 * height);
                canvas.fill(Vec2::new(0.5, top + half.y), &Shape::rectangle(half, 0.), color);
                top += height + 0.02;
            }
        }
    }
    canvas
}

/// Draws brush strokes that follow a field, in the colors of an underlying picture.
fn painting(random: &Random) -> Canvas {
    let model = random.one_of(&[landscape, portrait, dead_leaves, flowers, shapes])(random);
    let flow = smooth(random, SIZE, [3; 2]);
    let mut canvas = model.clone();
    let length = random.uniform(0.015, 0.06);
    let width = length * random.uniform(0.15, 0.4);
    let count = (0.8 / (length * width)) as usize;
    let turns = random.uniform(0.5, 3.);
    let spread = random.uniform(0.1, 0.6);
    for _ in 0..count.min(3000) {
        let spot = random.point();
        let along = Vec2::from_angle(turns * flow.sample(spot)) * 0.5 * length;
        let color = model.sample(spot) * (1. + spread * random.approx_normal()).max(0.2);
        canvas.fill(spot, &Shape::stroke(-along, along, 0.5 * width), color);
    }
    canvas
}

/// Draws overlapping shapes of all sizes, more of the small ones, as in the statistics of photos (dead leaves model).
fn dead_leaves(random: &Random) -> Canvas {
    let palette = Palette::draw(random, Purpose::Thing, random.count(3, 5));
    let other = Palette::draw(random, Purpose::Poster, 3);
    let mut canvas = Canvas::filled(SIZE, palette.color(0)).without_wrapping();
    let light = random.direction();
    let decline = random.sqrt_uniform(0.02, 0.3);
    for step in 0..random.count(40, 250) {
        // Large shapes first, so that they don't hide everything.
        let size = 0.4 / (1. + decline * step as f32) * random.uniform(0.6, 1.5);
        let own = if random.chance(0.8) { palette.ramp(random.unit()) } else { other.any(random) };
        let color = own * random.uniform(0.5, 1.3);
        let (turn, kind) = (random.direction(), random.count(0, 2));
        let half = Vec2::new(1., random.uniform(0.3, 1.)) * size;
        let shading = random.uniform(0., 0.5);
        let leaf = match kind {
            0 => Shape::ellipse(half),
            1 => Shape::rectangle(half, 0.2 * half.y),
            _ => Shape::polygon(0.7 * size, 3),
        };
        let leaf = leaf.turned(turn);
        canvas.stamp(random.point(), Vec2::splat(1.42 * size), |offset| {
            let lit = 1. + shading * offset.dot(light) / size;
            (color * lit.max(0.1), leaf.distance(offset))
        });
    }
    canvas
}

/// Draws flowers with stems and leaves in front of a plain background.
fn flowers(random: &Random) -> Canvas {
    let wall = Palette::draw(random, Purpose::Wall, 1).color(0);
    let mut canvas = Canvas::filled(SIZE, wall).without_wrapping();
    let foot = Vec2::new(random.uniform(0.4, 0.6), random.uniform(0.8, 1.1));
    let green = Palette::from_theme(random, GREENS, 3);
    for _ in 0..random.count(3, 16) {
        let head = Vec2::new(random.uniform(0.12, 0.88), random.uniform(0.1, 0.6));
        let half = 0.5 * (foot - head);
        canvas.fill(head + half, &Shape::stroke(-half, half, 0.005), palette_shade(random, &green));
        for _ in 0..random.count(0, 3) {
            let (place, turn) = (head.lerp(foot, random.uniform(0.2, 0.9)), random.direction());
            let (length, leaf) = (random.uniform(0.08, 0.2), palette_shade(random, &green));
            canvas.fill(place, &Shape::leaf(length, 0.35 * length).turned(turn), leaf);
        }
        let petals = random_color_of_themes(random, &[(VIVID, 2.), (ACCENTS, 3.), (WHITES, 1.)]);
        let (count, depth) = (random.count(4, 14), random.uniform(0.2, 0.7));
        let mut radius = random.uniform(0.04, 0.14);
        for layer in 0..random.count(2, 4) {
            let color = petals * (1. - 0.2 * layer as f32);
            canvas.fill(head, &Shape::flower(radius, count, depth).turned(random.direction()), color);
            radius *= 0.65;
        }
        canvas.fill(head, &Shape::disk(0.6 * radius), random_theme_color(random, AUTUMN));
    }
    canvas
}

fn palette_shade(random: &Random, palette: &Palette) -> Vec3 {
    palette.ramp(random.unit()) * random.uniform(0.5, 1.1)
}

/// Draws a window and the view through it, in bright light.
fn window(random: &Random) -> Canvas {
    let mut canvas = landscape(random);
    let light = random.uniform(1., 1.8);
    canvas.update(|_, pixel| (pixel * light).min(Vec3::ONE));
    let frame = random_color_of_themes(random, &[(WHITES, 5.), (WOODS, 2.), (GRAYS, 2.)]);
    let panes = Vec2::new(random.count(1, 4) as f32, random.count(1, 4) as f32);
    let (bar, edge) = (random.uniform(0.005, 0.02), random.uniform(0.02, 0.06));
    let [left, right] = [(); 2].map(|()| if random.chance(0.3) { random.uniform(0.1, 0.35) } else { 0. });
    let cloth = random_theme_color(random, WHITES);
    let folds = random.uniform(60., 160.);
    canvas.update(|uv, outside| {
        let part = (uv * panes - (uv * panes).round()).abs() / panes;
        let near = (part - bar).min_element().min((uv.min(1. - uv) - edge).min_element());
        let seen = outside.lerp(frame * (0.75 + 10. * near.clamp(-0.025, 0.)), coverage(near, SIZE as f32));
        let curtain = uv.x < left || uv.x > 1. - right;
        if curtain { cloth * (0.75 + 0.2 * (uv.x * folds).sin()) } else { seen }
    });
    canvas
}

/// Draws the screen of a television or a monitor: windows, or only a faint reflection.
fn screen(random: &Random) -> Canvas {
    if random.chance(0.35) {
        let glimmer = random.uniform(0.02, 0.12);
        let slant = random.uniform(-1., 1.);
        return Canvas::from_fn(SIZE, |uv| {
            Vec3::splat(0.02 + glimmer * smoothstep(0.3, -0.3, uv.y - 0.5 + slant * (uv.x - 0.5)))
        });
    }
    let mut canvas = random.one_of(&[landscape, shapes])(random);
    let script = Script::draw(random);
    for _ in 0..random.count(0, 4) {
        let paper = if random.chance(0.6) { Vec3::splat(0.85) } else { Vec3::splat(0.04) };
        let half = Vec2::new(random.uniform(0.12, 0.45), random.uniform(0.12, 0.45));
        let middle = Vec2::new(random.uniform(0.2, 0.8), random.uniform(0.2, 0.8));
        canvas.fill(middle, &Shape::rectangle(half, 0.01), paper);
        let bar = Palette::draw(random, Purpose::Poster, 1).color(0);
        let title = Shape::rectangle(Vec2::new(half.x, 0.02), 0.);
        canvas.fill(middle - Vec2::new(0., half.y - 0.02), &title, bar);
        let ink = ink_for(random, paper);
        let corner = middle - half + Vec2::new(0.02, 0.06);
        script.paragraph(random, &mut canvas, corner, 2. * half - Vec2::new(0.04, 0.08), 0.018, ink);
    }
    canvas
}

/// Adds a mat and a frame around the picture.
fn frame(random: &Random, canvas: &mut Canvas) {
    let wood = random_color_of_themes(random, &[(WOODS, 3.), (GRAYS, 2.), (WHITES, 2.), (AUTUMN, 1.)]);
    let wood = wood * random.uniform(0.3, 1.);
    let mat = random_color_of_themes(random, &[(WHITES, 4.), (ACCENTS, 1.)]);
    let bar = random.uniform(0.015, 0.07);
    let margin = if random.chance(0.6) { random.uniform(0.03, 0.2) } else { 0. };
    let relief = random.uniform(0.1, 0.5);
    let inner = canvas.clone();
    let all = bar + margin;
    canvas.update(|uv, _| {
        let from_edge = uv.min(1. - uv);
        let near = from_edge.min_element();
        if near >= all {
            return inner.sample((uv - all) / (1. - 2. * all));
        }
        if near >= bar {
            // The shadow of the frame, and the cut edge of the mat.
            let cut = smoothstep(all - 0.004, all, near);
            return mat * (0.7 + 0.3 * smoothstep(bar, bar + 0.015, near)) * (1. - 0.25 * cut);
        }
        let lit = if from_edge.x < from_edge.y { uv.x < 0.5 } else { uv.y < 0.5 };
        let profile = (near / bar * std::f32::consts::PI).sin();
        wood * (0.7 + 0.3 * profile + if lit { relief } else { -relief } * (near / bar - 0.5))
    });
}
