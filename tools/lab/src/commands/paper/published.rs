//! The paper's printed numbers (`published.csv`).

use anyhow::{Context, Result, ensure};

/// Numbers of one row of one of the paper's tables; `None` where the paper prints none.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Published {
    /// PSNR, dB.
    pub psnr: Option<f64>,
    /// SSIM.
    pub ssim: Option<f64>,
    /// LPIPS (VGG).
    pub lpips: Option<f64>,
    /// Seconds from the inputs to one view, one A100.
    pub seconds: Option<f64>,
    /// Peak memory of that GPU, GB.
    pub gigabytes: Option<f64>,
}

impl Published {
    /// Returns whether the paper prints any number here.
    pub fn is_some(&self) -> bool {
        *self != Self::default()
    }
}

/// All lines: table, row, setting, numbers.
pub struct Book(Vec<([String; 3], Published)>);

impl Book {
    /// Reads the file that the program holds.
    ///
    /// # Errors
    /// A line that is not three names and five numbers.
    pub fn open() -> Result<Self> {
        let lines = include_str!("published.csv").lines().skip(1);
        lines
            .map(|l| line(l).with_context(|| format!("published.csv: `{l}`")))
            .collect::<Result<_>>()
            .map(Self)
    }

    /// The paper's numbers of a row, all absent where it has none.
    pub fn find(&self, table: &str, row: &str, setting: &str) -> Published {
        let found = self.0.iter().find(|(names, _)| *names == [table, row, setting]);
        found.map(|(_, numbers)| *numbers).unwrap_or_default()
    }
}

/// Parses a line. A name with a comma stands in quotation marks.
fn line(text: &str) -> Result<([String; 3], Published)> {
    let mut cells = vec![String::new()];
    let mut quoted = false;
    for c in text.chars() {
        match (c, cells.last_mut()) {
            ('"', _) => quoted = !quoted,
            (',', _) if !quoted => cells.push(String::new()),
            (c, Some(cell)) => cell.push(c),
            (_, None) => {}
        }
    }
    ensure!(cells.len() == 8, "expected 8 cells, got {}", cells.len());
    let number = |cell: &String| match cell.as_str() {
        "" => Ok(None),
        text => text.parse::<f64>().map(Some).with_context(|| format!("a number, got `{text}`")),
    };
    let values = cells[3..].iter().map(number).collect::<Result<Vec<_>>>()?;
    let names = [&cells[0], &cells[1], &cells[2]].map(Clone::clone);
    let [psnr, ssim, lpips, seconds, gigabytes] = [0, 1, 2, 3, 4].map(|i| values[i]);
    Ok((names, Published { psnr, ssim, lpips, seconds, gigabytes }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::commands::paper::tables::{TABLES, Table};

    #[test]
    fn every_line_belongs_to_a_row_of_a_table() {
        let book = Book::open().unwrap();
        assert_eq!(book.0.len(), 72);
        for (i, ([table, row, setting], numbers)) in book.0.iter().enumerate() {
            let place = format!("{table} {row} {setting}");
            let known = TABLES.iter().find(|t| t.id == table).unwrap_or_else(|| panic!("{place}"));
            let settings = known.settings.iter().any(|s| s.label == setting);
            assert!(settings && known.rows.iter().any(|r| r.name == row), "{place}");
            assert!(numbers.is_some(), "{place}");
            let again = book.0[..i].iter().any(|(names, _)| names == &book.0[i].0);
            assert!(!again, "{place} twice");
        }
        // Tables of the paper have numbers; its figures have none.
        for Table { id, .. } in TABLES {
            assert_eq!(
                book.0.iter().any(|(names, _)| names[0] == *id),
                id.starts_with('t'),
                "{id}"
            );
        }
        assert_eq!(book.find("t2", "SubSplat", "RE10K 512").seconds, Some(0.042));
        assert!(!book.find("t2", "SubSplat", "ACID 512").is_some());
        assert!(line("t1,a,b,1,2,3,4").is_err() && line("t1,a,b,1,2,3,4,x").is_err());
    }
}
