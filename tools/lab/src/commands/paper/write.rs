//! Results of a table as CSV and Markdown, the paper's numbers beside.

use super::published::Published;
use super::tables::{Kind, Table};
use std::fmt::Write;

/// Our numbers of a row in one setting.
#[derive(Clone, Debug, Default)]
pub struct Measured {
    /// PSNR, dB, of each seed.
    pub psnr: Vec<f64>,
    /// SSIM of each seed.
    pub ssim: Vec<f64>,
    /// LPIPS of each seed; empty without VGG's weights.
    pub lpips: Vec<f64>,
    /// Seconds from the inputs to one view.
    pub seconds: Option<f64>,
    /// Peak memory of the program, bytes.
    pub bytes: Option<u64>,
    /// Sides of the network's input and of the pictures, px.
    pub sides: Option<[usize; 2]>,
}

/// Numbers of a table in one setting.
pub struct Part {
    /// Name of the setting.
    pub label: &'static str,
    /// Name of the data.
    pub data: String,
    /// Number of scenes.
    pub scenes: usize,
    /// One for each row: its name, ours, the paper's.
    pub rows: Vec<(String, Measured, Published)>,
}

/// Columns of the CSV file.
const COLUMNS: &str = "table,row,setting,data,scenes,input,target,seeds,psnr,ssim,lpips,seconds,gigabytes,\
     psnr_by_seed,paper_psnr,paper_ssim,paper_lpips,paper_seconds,paper_gigabytes";

/// Mean of the seeds.
fn mean(values: &[f64]) -> Option<f64> {
    (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64)
}

impl Measured {
    fn gigabytes(&self) -> Option<f64> {
        self.bytes.map(|b| b as f64 / 1e9)
    }

    /// PSNR, SSIM, LPIPS, seconds, gigabytes: means over the seeds.
    fn numbers(&self) -> [Option<f64>; 5] {
        [mean(&self.psnr), mean(&self.ssim), mean(&self.lpips), self.seconds, self.gigabytes()]
    }
}

impl Published {
    fn numbers(&self) -> [Option<f64>; 5] {
        [self.psnr, self.ssim, self.lpips, self.seconds, self.gigabytes]
    }
}

/// Quotes a cell where necessary (RFC 4180).
fn quoted(text: &str) -> String {
    if text.contains([',', '"']) {
        format!("\"{}\"", text.replace('"', "\"\""))
    } else {
        text.to_owned()
    }
}

/// Formats a table as CSV: one line for each row and setting. Missing numbers are empty.
pub fn csv(table: &Table, parts: &[Part]) -> String {
    let mut text = format!("{COLUMNS}\n");
    for part in parts {
        for (name, ours, paper) in &part.rows {
            let cell = |v: Option<f64>| v.map_or_else(String::new, |v| format!("{v:.6}"));
            let printed = |v: Option<f64>| v.map_or_else(String::new, |v| v.to_string());
            let side = |i: usize| ours.sides.map_or_else(String::new, |s| s[i].to_string());
            let seeds: Vec<String> = ours.psnr.iter().map(|v| format!("{v:.6}")).collect();
            let ours_cells = ours.numbers().map(cell).join(",");
            let paper_cells = paper.numbers().map(printed).join(",");
            // Writing to a String does not fail.
            let _ = writeln!(
                text,
                "{},{},{},{},{},{},{},{},{ours_cells},{},{paper_cells}",
                table.id,
                quoted(name),
                part.label,
                quoted(&part.data),
                part.scenes,
                side(0),
                side(1),
                ours.psnr.len(),
                seeds.join(" "),
            );
        }
    }
    text
}

/// Formats a table as Markdown: one table for each setting, then the notes.
pub fn markdown(table: &Table, parts: &[Part], notes: &[String]) -> String {
    let mut text = format!("# {}: {}\n", table.id, table.title);
    let columns = columns(table.kind);
    for part in parts {
        let sides = sides(part).map_or_else(String::new, |sides| format!(", {sides}"));
        let _ = writeln!(
            text,
            "\n## {}: measured on {}, {} scene{}{sides}\n",
            part.label,
            part.data,
            part.scenes,
            if part.scenes == 1 { "" } else { "s" }
        );
        let mut lines = vec![vec!["".to_owned()]];
        let published = part.rows.iter().any(|(_, _, paper)| paper.is_some());
        for (name, _) in &columns {
            lines[0].push((*name).to_owned());
            lines[0].extend(published.then(|| "paper".to_owned()));
        }
        for (name, ours, paper) in &part.rows {
            let mut line = vec![name.clone()];
            let (ours, paper) = (ours.numbers(), paper.numbers());
            for (i, (_, digits)) in columns.iter().enumerate() {
                let cell =
                    |v: Option<f64>| v.map_or_else(|| "-".to_owned(), |v| format!("{v:.digits$}"));
                line.push(cell(ours[i + offset(table.kind)]));
                line.extend(published.then(|| cell(paper[i + offset(table.kind)])));
            }
            lines.push(line);
        }
        text += &aligned(&lines);
    }
    text.push('\n');
    for note in notes {
        let _ = writeln!(text, "* {note}");
    }
    text
}

/// Sides of the inputs and of the pictures: `256 and 512 to 512 px`.
fn sides(part: &Part) -> Option<String> {
    let mut all: Vec<[usize; 2]> = part.rows.iter().filter_map(|(_, ours, _)| ours.sides).collect();
    all.sort_unstable();
    all.dedup();
    let target = all.first()?[1];
    let inputs: Vec<String> = all.iter().map(|[input, _]| input.to_string()).collect();
    Some(format!("{} to {target} px", inputs.join(" and ")))
}

/// Index of the first number that a kind of table shows.
fn offset(kind: Kind) -> usize {
    if kind.has_scores() { 0 } else { 3 }
}

/// Names and digits of the shown numbers.
fn columns(kind: Kind) -> Vec<(&'static str, usize)> {
    let mut columns = Vec::new();
    if kind.has_scores() {
        columns.extend([("PSNR", 2), ("SSIM", 3), ("LPIPS", 3)]);
    }
    if kind.has_seconds() {
        columns.push(("s", 3));
    }
    if kind.has_memory() {
        columns.push(("GB", 2));
    }
    columns
}

/// Formats lines as a Markdown table whose columns are aligned: the first to the left.
fn aligned(lines: &[Vec<String>]) -> String {
    let count = lines.first().map_or(0, Vec::len);
    let width = |c: usize| lines.iter().map(|l| l[c].chars().count()).max().unwrap_or(0).max(3);
    let widths: Vec<usize> = (0..count).map(width).collect();
    let mut text = String::new();
    for (i, line) in lines.iter().enumerate() {
        let cells = line.iter().zip(&widths).enumerate().map(|(c, (cell, &width))| match c {
            0 => format!(" {cell:<width$} |"),
            _ => format!(" {cell:>width$} |"),
        });
        let _ = writeln!(text, "|{}", cells.collect::<String>());
        if i == 0 {
            let rule = |(c, w): (usize, &usize)| match c {
                0 => format!("{}|", "-".repeat(w + 2)),
                _ => format!("{}:|", "-".repeat(w + 1)),
            };
            let rules = widths.iter().enumerate().map(rule).collect::<String>();
            let _ = writeln!(text, "|{rules}");
        }
    }
    text
}

/// Compares the order of the rows with the paper's: one line for each setting in which two rows or
/// more have a PSNR of ours and of the paper.
pub fn order(parts: &[Part]) -> Vec<String> {
    parts.iter().filter_map(order_of).collect()
}

fn order_of(part: &Part) -> Option<String> {
    let known = part.rows.iter().filter_map(|(_, ours, paper)| {
        paper.psnr.filter(|_| !ours.psnr.is_empty()).map(|psnr| (ours, psnr))
    });
    let known: Vec<_> = known.collect();
    let seeds = known.iter().map(|(ours, _)| ours.psnr.len()).max().filter(|_| known.len() > 1)?;
    let mut pairs = Vec::new();
    for (i, a) in known.iter().enumerate() {
        pairs.extend(known[i + 1..].iter().map(|b| (a, b)));
    }
    // Rows without a training have one result, which stands for every seed.
    let of = |ours: &Measured, seed: usize| ours.psnr[seed.min(ours.psnr.len() - 1)];
    let agree = |seed: usize| {
        let same = pairs.iter().filter(|((a, paper_a), (b, paper_b))| {
            (of(a, seed) - of(b, seed)).total_cmp(&0.0) == (paper_a - paper_b).total_cmp(&0.0)
        });
        same.count()
    };
    let counts: Vec<usize> = (0..seeds).map(agree).collect();
    let total = pairs.len();
    let verdict = if counts.iter().all(|c| *c == total) { "confirmed" } else { "not confirmed" };
    let plural = if total == 1 { "" } else { "s" };
    let each: Vec<String> = counts.iter().map(|c| format!("{c} of {total}")).collect();
    let by_seed = if seeds > 1 { " (one number a seed)" } else { "" };
    Some(format!(
        "{}: the paper's order of rows by PSNR is {verdict}: {} pair{plural} of rows as in the \
         paper{by_seed}.",
        part.label,
        each.join(", "),
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn part(ours: &[(&[f64], Option<f64>)]) -> Part {
        let row = |(i, (psnr, paper)): (usize, &(&[f64], Option<f64>))| {
            let measured = Measured { psnr: psnr.to_vec(), ..Measured::default() };
            let paper = Published { psnr: *paper, ..Published::default() };
            (format!("row, {i}"), measured, paper)
        };
        let rows = ours.iter().enumerate().map(row).collect();
        Part { label: "RE10K 512", data: "rooms".to_owned(), scenes: 1, rows }
    }

    #[test]
    fn the_order_counts_pairs_of_each_seed() {
        let same = part(&[(&[1.0], Some(10.0)), (&[2.0, 3.0], Some(20.0)), (&[9.0], None)]);
        let line = order(&[same]).remove(0);
        assert!(line.contains(" confirmed: 1 of 1, 1 of 1 pair of"), "{line}");
        let other = part(&[
            (&[1.0, 5.0], Some(10.0)),
            (&[2.0, 3.0], Some(20.0)),
            (&[4.0, 6.0], Some(30.0)),
        ]);
        let line = order(&[other]).remove(0);
        assert!(line.contains("not confirmed: 3 of 3, 2 of 3 pairs"), "{line}");
        assert!(order(&[part(&[(&[1.0], Some(1.0)), (&[], Some(2.0))])]).is_empty());
    }

    #[test]
    fn cells_with_commas_are_quoted_and_means_printed() {
        let table = super::super::tables::TABLES.first().unwrap();
        let mut parts = [part(&[(&[1.0, 2.0], Some(10.5)), (&[], None)])];
        let text = csv(table, &parts);
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(
            lines[1],
            "t1,\"row, 0\",RE10K 512,rooms,1,,,2,1.500000,,,,,1.000000 2.000000,10.5,,,,"
        );
        assert_eq!(lines[2], "t1,\"row, 1\",RE10K 512,rooms,1,,,0,,,,,,,,,,,");
        parts[0].rows[0].1.sides = Some([64, 64]);
        parts[0].rows[1].1.sides = Some([32, 64]);
        let text = markdown(table, &parts, &["a note".to_owned()]);
        assert!(text.contains("measured on rooms, 1 scene, 32 and 64 to 64 px"), "{text}");
        assert!(text.contains("| row, 0 | 1.50 | 10.50 |"), "{text}");
        assert!(text.contains("| row, 1 |    - |     - |"), "{text}");
        assert!(text.ends_with("\n* a note\n"), "{text}");
    }
}
