//! Detection of JPEGs that don't hold all of their data (ITU-T T.81). Decoders don't report missing data: they fill it with grey.

use std::io::{BufRead, Seek};

/// Number of bits of a code that are looked up at once.
const LOOKUP_BITS: u32 = 9;
/// Maximum number of scans that are checked; decoders refuse more.
const MAX_SCANS: usize = 100;
/// Bit mask of all 64 coefficients of a block.
const ALL_COEFFICIENTS: u64 = u64::MAX;

const SOI: u8 = 0xd8;
const EOI: u8 = 0xd9;
const SOS: u8 = 0xda;
const DHT: u8 = 0xc4;
const DRI: u8 = 0xdd;
/// Markers of Huffman-coded frames: baseline, extended sequential, progressive.
const HUFFMAN_FRAMES: [u8; 3] = [0xc0, 0xc1, PROGRESSIVE];
const PROGRESSIVE: u8 = 0xc2;

fn is_frame(marker: u8) -> bool {
    matches!(marker, 0xc0..=0xcf) && !matches!(marker, DHT | 0xc8 | 0xcc)
}

fn is_standalone(marker: u8) -> bool {
    matches!(marker, 0x01 | 0xd0..=SOI)
}

/// Returns (width, height) from a JPEG's headers, without reading its data, or `None` if it isn't a JPEG.
pub(super) fn jpeg_size(mut reader: impl BufRead + Seek) -> Option<(u32, u32)> {
    let mut pair = [0; 2];
    reader.read_exact(&mut pair).ok()?;
    if pair != [0xff, SOI] {
        return None;
    }
    loop {
        reader.read_exact(&mut pair).ok()?;
        let [0xff, mut marker] = pair else { return None };
        while marker == 0xff {
            reader.read_exact(std::slice::from_mut(&mut marker)).ok()?;
        }
        if is_standalone(marker) {
            continue;
        }
        reader.read_exact(&mut pair).ok()?;
        if is_frame(marker) {
            let mut frame = [0; 5];
            reader.read_exact(&mut frame).ok()?;
            let [_, h1, h0, w1, w0] = frame;
            return Some([[w1, w0], [h1, h0]].map(|side| u16::from_be_bytes(side).into()).into());
        }
        if marker == SOS {
            return None;
        }
        reader.seek_relative(i64::from(u16::from_be_bytes(pair)) - 2).ok()?;
    }
}

/// A JPEG that holds all of its data.
pub(super) struct CheckedJpeg {
    /// Number of colour components; `None` if the file isn't Huffman-coded, so that the check is left to the decoder.
    pub components: Option<usize>,
    /// `true` if the file has an end marker.
    pub is_marked: bool,
}

/// Marker at the end of a JPEG.
pub(super) const END_MARKER: [u8; 2] = [0xff, EOI];

/// Walks through the data of a JPEG from its first block to its last. The end marker may be missing if nothing else is.
///
/// # Errors
/// Returns a description of what is missing.
pub(super) fn check_jpeg(bytes: &[u8]) -> Result<CheckedJpeg, String> {
    let mut walker =
        JpegWalker { bytes, at: 2, frame: None, tables: Default::default(), restart_interval: 0 };
    let mut unread = false;
    for _ in 0..MAX_SCANS {
        match walker.next_scan()? {
            Next::Scan(scan) => unread = walker.walk_scan(&scan)?,
            Next::End { marked, skipped } => return walker.finish(marked, skipped || unread),
            Next::Unknown => break,
        }
    }
    Ok(CheckedJpeg { components: None, is_marked: true })
}

struct JpegWalker<'a> {
    bytes: &'a [u8],
    at: usize,
    frame: Option<Frame>,
    /// Huffman tables for DC and for AC coefficients.
    tables: [[Option<HuffmanTable>; 4]; 2],
    /// Restart interval in MCUs; 0 if there is none.
    restart_interval: usize,
}

struct Frame {
    is_progressive: bool,
    width: usize,
    height: usize,
    components: Vec<Component>,
}

struct Component {
    id: u8,
    /// Number of blocks in an MCU, horizontally (`across`) and vertically (`down`).
    across: usize,
    down: usize,
    /// Number of blocks in a row, over all MCUs.
    stride: usize,
    /// Bit mask of the nonzero coefficients of each block, which progressive scans refine.
    nonzero: Vec<u64>,
    /// `true` if a scan has contained this component.
    is_begun: bool,
    /// Bit mask of the coefficients whose lowest bit has been transmitted.
    complete: u64,
}

struct Scan {
    /// Index of each component, and the indices of its tables for DC and AC coefficients.
    components: Vec<(usize, usize, usize)>,
    first: u32,
    last: u32,
    /// `true` if the scan adds bits to coefficients that earlier scans began.
    refines: bool,
    /// Position of the lowest bit that the scan transmits.
    low: u8,
}

enum Next {
    Scan(Scan),
    /// End of the file or its end marker. `skipped` is `true` if bytes before it belong to no segment.
    End {
        marked: bool,
        skipped: bool,
    },
    Unknown,
}

impl JpegWalker<'_> {
    /// Reads segments up to the header of the next scan.
    fn next_scan(&mut self) -> Result<Next, String> {
        let mut skipped = false;
        loop {
            let Some(marker) = self.next_marker(&mut skipped) else {
                return Ok(Next::End { marked: false, skipped });
            };
            match marker {
                EOI => return Ok(Next::End { marked: true, skipped }),
                _ if is_standalone(marker) => continue,
                _ => {}
            }
            let cut = || format!("its header is cut short after {} bytes", self.bytes.len());
            let length = self.bytes.get(self.at..).and_then(|rest| rest.first_chunk()).ok_or_else(cut)?;
            let length = usize::from(u16::from_be_bytes(*length));
            let segment = self.bytes.get(self.at + 2..self.at + length.max(2)).ok_or_else(cut)?;
            self.at += length.max(2);
            let is_sound = match marker {
                DHT => self.read_tables(segment).is_some(),
                DRI => match segment.first_chunk() {
                    Some(interval) => {
                        self.restart_interval = usize::from(u16::from_be_bytes(*interval));
                        true
                    }
                    None => false,
                },
                SOS => match self.scan_of(segment) {
                    Some(scan) => return Ok(Next::Scan(scan)),
                    None => false,
                },
                _ if HUFFMAN_FRAMES.contains(&marker) && self.frame.is_none() => {
                    self.frame = Frame::parse(segment, marker == PROGRESSIVE);
                    self.frame.is_some()
                }
                _ if is_frame(marker) => return Ok(Next::Unknown),
                _ => true,
            };
            if !is_sound {
                return Err("it has a damaged header".into());
            }
        }
    }

    fn next_marker(&mut self, skipped: &mut bool) -> Option<u8> {
        loop {
            let rest = self.bytes.get(self.at..)?;
            let Some(offset) = rest.iter().position(|&byte| byte == 0xff) else {
                *skipped |= !rest.is_empty();
                return None;
            };
            *skipped |= offset > 0;
            self.at += offset + 1;
            match *self.bytes.get(self.at)? {
                0xff => {}
                0 => *skipped = true,
                marker => {
                    self.at += 1;
                    return Some(marker);
                }
            }
        }
    }

    fn read_tables(&mut self, mut segment: &[u8]) -> Option<()> {
        while let Some((&[head], rest)) = segment.split_first_chunk() {
            let (counts, rest) = rest.split_first_chunk::<16>()?;
            let symbols = counts.iter().map(|&count| usize::from(count)).sum();
            let (symbols, rest) = rest.split_at_checked(symbols)?;
            let slot = self.tables.get_mut(usize::from(head >> 4))?.get_mut(usize::from(head & 15))?;
            *slot = Some(HuffmanTable::new(counts, symbols)?);
            segment = rest;
        }
        Some(())
    }

    fn scan_of(&self, segment: &[u8]) -> Option<Scan> {
        let frame = self.frame.as_ref()?;
        let (&count, rest) = segment.split_first()?;
        let (selectors, &[first, last, bits]) = rest.split_at_checked(2 * usize::from(count))? else {
            return None;
        };
        let component = |selector: &[u8]| {
            let index = frame.components.iter().position(|component| component.id == selector[0])?;
            Some((index, usize::from(selector[1] >> 4), usize::from(selector[1] & 15)))
        };
        let components = selectors.chunks_exact(2).map(component).collect::<Option<Vec<_>>>()?;
        let (first, last) = if frame.is_progressive { (first, last) } else { (0, 63) };
        let is_sound = first <= last
            && last < 64
            && !components.is_empty()
            // A scan of AC coefficients contains a single component.
            && (!frame.is_progressive || if first == 0 { last == 0 } else { components.len() == 1 });
        is_sound.then_some(Scan {
            components,
            first: first.into(),
            last: last.into(),
            refines: frame.is_progressive && bits >> 4 != 0,
            low: if frame.is_progressive { bits & 15 } else { 0 },
        })
    }

    /// Walks through the data of `scan` and returns `true` if bytes are left over.
    fn walk_scan(&mut self, scan: &Scan) -> Result<bool, String> {
        let JpegWalker { bytes, frame, tables, restart_interval, .. } = self;
        let frame = frame.as_mut().expect("a scan is of a frame");
        let mut bits = BitReader { bytes, at: self.at, buffer: 0, count: 0 };
        let (across, down) = frame.grid(scan);
        let mut run = 0;
        for mcu in 0..across * down {
            let cut = || format!("its data end after {mcu} of {} blocks of a scan", across * down);
            if *restart_interval > 0 && mcu > 0 && mcu % *restart_interval == 0 {
                bits.restart().ok_or_else(cut)?;
                run = 0;
            }
            let (row, column) = (mcu / across, mcu % across);
            for &(index, dc, ac) in &scan.components {
                let component = &mut frame.components[index];
                let tables =
                    [&tables[0].get(dc), &tables[1].get(ac)].map(|table| table.and_then(Option::as_ref));
                let (wide, high) =
                    if scan.components.len() == 1 { (1, 1) } else { (component.across, component.down) };
                for (y, x) in (0..high).flat_map(|y| (0..wide).map(move |x| (y, x))) {
                    let block = (row * high + y) * component.stride + column * wide + x;
                    let mut unused = 0;
                    let nonzero = component.nonzero.get_mut(block).unwrap_or(&mut unused);
                    bits.walk_block(scan, frame.is_progressive, tables, nonzero, &mut run).ok_or_else(cut)?;
                }
            }
        }
        for &(index, ..) in &scan.components {
            let component = &mut frame.components[index];
            component.is_begun = true;
            if scan.low == 0 {
                component.complete |=
                    (ALL_COEFFICIENTS >> (63 - scan.last)) & (ALL_COEFFICIENTS << scan.first);
            }
        }
        self.at = bits.at;
        Ok(bits.count >= 8)
    }

    /// Returns the result after the whole file has been read. `marked` is `true` if there was an end marker, `unread` if bytes are left
    /// over.
    fn finish(&self, marked: bool, unread: bool) -> Result<CheckedJpeg, String> {
        let Some(frame) = &self.frame else { return Err("it has no data".into()) };
        // A progressive file may end after any scan, as its author chose. A file without an end marker must hold all of its data.
        let is_whole = |component: &Component| match marked {
            true => component.is_begun,
            false => component.complete == ALL_COEFFICIENTS && !unread,
        };
        match frame.components.iter().all(is_whole) {
            true => Ok(CheckedJpeg { components: Some(frame.components.len()), is_marked: marked }),
            false => Err("its data end before the image does".into()),
        }
    }
}

impl Frame {
    fn parse(segment: &[u8], is_progressive: bool) -> Option<Self> {
        let (&[8, h1, h0, w1, w0, count], rest) = segment.split_first_chunk()? else { return None };
        let [width, height] = [[w1, w0], [h1, h0]].map(|side| usize::from(u16::from_be_bytes(side)));
        let entries = rest.get(..3 * usize::from(count))?.chunks_exact(3);
        let sampling = |entry: &[u8]| (usize::from(entry[1] >> 4), usize::from(entry[1] & 15));
        let is_sound =
            |&(across, down): &(usize, usize)| (1..=4).contains(&across) && (1..=4).contains(&down);
        let samplings: Vec<_> = entries.clone().map(sampling).collect();
        if width == 0 || height == 0 || samplings.is_empty() || !samplings.iter().all(is_sound) {
            return None;
        }
        let mut frame = Frame { is_progressive, width, height, components: vec![] };
        for (entry, &(across, down)) in entries.zip(&samplings) {
            frame.components.push(Component {
                id: entry[0],
                across,
                down,
                stride: 0,
                nonzero: vec![],
                is_begun: false,
                complete: 0,
            });
        }
        let (mcus_across, mcus_down) = frame.mcus();
        for component in &mut frame.components {
            component.stride = mcus_across * component.across;
            if is_progressive {
                component.nonzero = vec![0; component.stride * mcus_down * component.down];
            }
        }
        Some(frame)
    }

    /// Returns the largest sampling factors of the components, across and down.
    fn sampling(&self) -> (usize, usize) {
        let largest = |side: fn(&Component) -> usize| self.components.iter().map(side).max().unwrap_or(1);
        (largest(|component| component.across), largest(|component| component.down))
    }

    /// Returns the number of MCUs of a scan of all components, across and down.
    fn mcus(&self) -> (usize, usize) {
        let (across, down) = self.sampling();
        (self.width.div_ceil(8 * across), self.height.div_ceil(8 * down))
    }

    /// Returns the number of MCUs of `scan`, across and down. For a single component, they are the blocks that cover part of the image.
    fn grid(&self, scan: &Scan) -> (usize, usize) {
        let [(index, ..)] = scan.components.as_slice() else { return self.mcus() };
        let (component, (across, down)) = (&self.components[*index], self.sampling());
        let blocks = |side: usize, own: usize, largest: usize| (side * own).div_ceil(8 * largest);
        (blocks(self.width, component.across, across), blocks(self.height, component.down, down))
    }
}

/// A Huffman code.
struct HuffmanTable {
    /// Length and symbol of a code, by the next [`LOOKUP_BITS`] bits; the length is 0 if the code is longer.
    lookup: Vec<(u8, u8)>,
    /// For each code length, the first code beyond those of this length, shifted to 16 bits, and the offset from a code to the index of its
    /// symbol.
    ends: [(u32, i32); 17],
    symbols: Vec<u8>,
}

impl HuffmanTable {
    fn new(counts: &[u8; 16], symbols: &[u8]) -> Option<Self> {
        let mut lookup = vec![(0, 0); 1 << LOOKUP_BITS];
        let mut ends = [(0, 0); 17];
        let (mut code, mut index) = (0u32, 0usize);
        for (length, &count) in (1..).zip(counts) {
            ends[length as usize].1 = index as i32 - code as i32;
            for _ in 0..count {
                if code >> length != 0 {
                    return None;
                }
                if length <= LOOKUP_BITS {
                    let (from, each) =
                        ((code << (LOOKUP_BITS - length)) as usize, 1 << (LOOKUP_BITS - length));
                    lookup[from..from + each].fill((length as u8, symbols[index]));
                }
                (code, index) = (code + 1, index + 1);
            }
            ends[length as usize].0 = code << (16 - length);
            code <<= 1;
        }
        Some(HuffmanTable { lookup, ends, symbols: symbols.to_vec() })
    }
}

/// Bit reader for the data between two markers.
struct BitReader<'a> {
    bytes: &'a [u8],
    at: usize,
    /// Unread bits; the highest bit is the next one.
    buffer: u64,
    count: u32,
}

impl BitReader<'_> {
    /// Fills the buffer until it has at least 32 bits, or all bits that are left before the next marker.
    #[inline]
    fn fill(&mut self) {
        if self.count >= 32 {
            return;
        }
        if let Some(next) = self.bytes.get(self.at..).and_then(|rest| rest.first_chunk::<4>())
            && !next.contains(&0xff)
        {
            self.buffer |= u64::from(u32::from_be_bytes(*next)) << (32 - self.count);
            (self.at, self.count) = (self.at + 4, self.count + 32);
            return;
        }
        while self.count <= 56 {
            let Some(&byte) = self.bytes.get(self.at) else { return };
            if byte == 0xff {
                if self.bytes.get(self.at + 1) != Some(&0) {
                    return;
                }
                self.at += 1;
            }
            self.buffer |= u64::from(byte) << (56 - self.count);
            (self.at, self.count) = (self.at + 1, self.count + 8);
        }
    }

    /// Takes up to 16 bits. [`BitReader::fill`] must be called first.
    #[inline]
    fn take(&mut self, count: u32) -> Option<u32> {
        self.count = self.count.checked_sub(count)?;
        let taken = if count == 0 { 0 } else { (self.buffer >> (64 - count)) as u32 };
        self.buffer <<= count;
        Some(taken)
    }

    /// Returns the next symbol. At least 16 bits remain in the buffer after it, unless the data end before.
    #[inline]
    fn symbol(&mut self, table: &HuffmanTable) -> Option<u8> {
        self.fill();
        let (length, symbol) = table.lookup[(self.buffer >> (64 - LOOKUP_BITS)) as usize];
        if length > 0 {
            self.take(length.into())?;
            return Some(symbol);
        }
        let next = (self.buffer >> 48) as u32;
        let length = (LOOKUP_BITS + 1..=16).find(|&length| next < table.ends[length as usize].0)?;
        let index = (next >> (16 - length)) as i32 + table.ends[length as usize].1;
        self.take(length)?;
        table.symbols.get(usize::try_from(index).ok()?).copied()
    }

    /// Continues after the next restart marker, or returns `None` if it is missing.
    fn restart(&mut self) -> Option<()> {
        let rest = self.bytes.get(self.at..)?;
        let offset = rest.windows(2).position(|pair| pair[0] == 0xff && !matches!(pair[1], 0 | 0xff))?;
        matches!(rest[offset + 1], 0xd0..=0xd7).then_some(())?;
        (self.at, self.buffer, self.count) = (self.at + offset + 2, 0, 0);
        Some(())
    }

    /// Walks through a block. `run` is the number of blocks that follow without new coefficients.
    #[inline]
    fn walk_block(
        &mut self,
        scan: &Scan,
        is_progressive: bool,
        [dc, ac]: [Option<&HuffmanTable>; 2],
        nonzero: &mut u64,
        run: &mut u32,
    ) -> Option<()> {
        if scan.first == 0 {
            if scan.refines {
                self.fill();
                self.take(1)?;
            } else {
                let size = self.symbol(dc?)?;
                self.take(u32::from(size).min(16))?;
            }
        }
        match (is_progressive, scan.refines) {
            (false, _) => self.walk_sequential(ac?),
            (true, _) if scan.last == 0 => Some(()),
            (true, false) => self.walk_ac_first(scan, ac?, nonzero, run),
            (true, true) => self.walk_ac_refine(scan, ac?, nonzero, run),
        }
    }

    #[inline]
    fn walk_sequential(&mut self, table: &HuffmanTable) -> Option<()> {
        let mut k = 1;
        while k < 64 {
            let symbol = self.symbol(table)?;
            match symbol & 15 {
                0 if symbol == 0xf0 => k += 16,
                0 => break,
                size => {
                    self.take(size.into())?;
                    k += u32::from(symbol >> 4) + 1;
                }
            }
        }
        Some(())
    }

    fn walk_ac_first(
        &mut self,
        scan: &Scan,
        table: &HuffmanTable,
        nonzero: &mut u64,
        run: &mut u32,
    ) -> Option<()> {
        if *run > 0 {
            *run -= 1;
            return Some(());
        }
        let mut k = scan.first;
        while k <= scan.last {
            let symbol = self.symbol(table)?;
            let (zeros, size) = (u32::from(symbol >> 4), u32::from(symbol & 15));
            match size {
                0 if zeros < 15 => {
                    *run = (1 << zeros) + self.take(zeros)? - 1;
                    break;
                }
                0 => k += 16,
                _ => {
                    self.take(size)?;
                    *nonzero |= 1 << (k + zeros).min(63);
                    k += zeros + 1;
                }
            }
        }
        Some(())
    }

    fn walk_ac_refine(
        &mut self,
        scan: &Scan,
        table: &HuffmanTable,
        nonzero: &mut u64,
        run: &mut u32,
    ) -> Option<()> {
        let mut k = scan.first;
        while *run == 0 && k <= scan.last {
            let symbol = self.symbol(table)?;
            let (mut zeros, size) = (u32::from(symbol >> 4), symbol & 15);
            if size == 0 && zeros < 15 {
                *run = (1 << zeros) + self.take(zeros)?;
                break;
            }
            if size != 0 {
                self.take(1)?;
            }
            // Each coefficient that is nonzero already takes a bit, up to the zero coefficient that the symbol refers to.
            while k <= scan.last {
                if *nonzero >> k & 1 == 1 {
                    self.fill();
                    self.take(1)?;
                } else if zeros == 0 {
                    break;
                } else {
                    zeros -= 1;
                }
                k += 1;
            }
            if size != 0 && k <= scan.last {
                *nonzero |= 1 << k;
            }
            k += 1;
        }
        if *run > 0 {
            for k in k..=scan.last {
                if *nonzero >> k & 1 == 1 {
                    self.fill();
                    self.take(1)?;
                }
            }
            *run -= 1;
        }
        Some(())
    }
}
