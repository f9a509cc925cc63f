// Files that esbuild makes a part of the page.
declare module "*.css";
declare module "*.txt" {
  const text: string;
  export default text;
}
