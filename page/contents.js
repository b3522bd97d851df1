// A page from outside: node programs that drive what a built page holds.

/** What a page holds, from its text: for programs without a document. */
export function contentsOf(html) {
  const [, text] = html.match(/<script type="application\/json" id="contents">(.*?)<\/script>/s);
  return JSON.parse(text);
}
